"""Worst-case H2 designs of random problems: certificates against perturbations found by force, lower bounds against other observers.

Truth: the error density is computed here from the matrices of the problem, in physical units, for perturbations that climb at every frequency of a fine
grid; it never uses the ball, the bound, the quadrature or the closed-loop systems of kros. A lower bound is held against certified
values of observers that are not the one found: none at all, perturbed filters, constant gains that were searched for, the design of the other injection.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from campaign import Tally, main

from kros.core import StateSpace, SynthesisError, gain, hinf_norm
from kros.synthesis import Injection, ObserverProblem, Synthesis, worst_case_h2
from kros.synthesis.worst_case.certificate import certify_errors
from kros.uncertainty.forms import Form

Array = npt.NDArray[Any]
FORMS = tuple(Form)
POINTS, CLIMB, OTHERS = 400, 8, 3
ORDERS = (0, 1, 0, 0, 2, 0, 1, 0)  # of shaping filters: their fits take most of the time


def weight(rng: np.random.Generator, order: int, rows: int, columns: int, size: float) -> StateSpace:
    """A stable weight of a given order, some of it lightly damped."""
    blocks, k = [], order
    while k > 0:
        radius = 1 - 10.0 ** rng.uniform(-3.5, -0.3)
        if k >= 2 and rng.random() < 0.6:
            angle = np.exp(rng.uniform(np.log(1e-2), np.log(3.0)))
            blocks.append(radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]))
        else:
            blocks.append(np.array([[radius]]))
        k -= len(blocks[-1])
    A = np.zeros((order, order))
    at = 0
    for block in blocks:
        A[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    B, C = (
        rng.standard_normal((order, columns)),
        rng.standard_normal((rows, order)) * (1 - np.abs(np.linalg.eigvals(A)).max(initial=0)),
    )
    system = StateSpace(A, B, C, rng.standard_normal((rows, columns)), 1.0)
    return _times(system, size / max(hinf_norm(system, 1e-3), 1e-9))


def _times(system: StateSpace, size: float) -> StateSpace:
    return StateSpace(system.A, system.B, system.C * size, system.D * size, system.dt)


def nominal(rng: np.random.Generator, n: int, m: int) -> StateSpace:
    """A stable model: some lightly damped, some with a badly conditioned basis as Koopman models have."""
    A = rng.standard_normal((n, n))
    A *= (1 - 10.0 ** rng.uniform(-3, -0.3)) / np.abs(np.linalg.eigvals(A)).max()
    T = np.eye(n)
    if rng.random() < 0.4:
        T = T + np.triu(10.0 ** rng.uniform(-1, 1.5) * rng.standard_normal((n, n)), 1)
    A, B = T @ A @ np.linalg.inv(T), T @ rng.standard_normal((n, m))
    return StateSpace(A, B, np.eye(n), np.zeros((n, m)), 1.0)


def random_problem(rng: np.random.Generator) -> ObserverProblem:
    """One problem; the loop of the uncertainty has a gain below 0.9."""
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    q = int(rng.integers(1, n + 1))
    form = FORMS[int(rng.integers(len(FORMS)))]
    model = nominal(rng, n, m)
    units = 10.0 ** rng.uniform(-3, 3, n) if rng.random() < 0.4 else np.ones(n)
    model = StateSpace(model.A * units[:, None] / units, model.B * units[:, None], np.eye(n), np.zeros((n, m)), 1.0)
    scale = units * np.sqrt(np.diag(_covariance(model.A / units[:, None] * units, model.B / units[:, None])) + 1e-6)
    parts: dict[str, Any] = {
        "nominal": model,
        "C": np.eye(n)[:q],
        "input_scale": np.ones(m),
        "output_scale": scale,
        "form": form,
    }
    parts["noise"] = scale[:q] * 10.0 ** rng.uniform(-4, 0.5, q)
    at_input = form in (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_ADDITIVE, Form.INVERSE_INPUT_MULTIPLICATIVE)
    sees_input = form in (Form.ADDITIVE, Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE)
    rows, columns = (m if at_input else n), (m if sees_input else n)
    orders = rng.integers(0, 5), rng.integers(0, 3)
    parts["W_L"] = weight(rng, int(orders[0]), rows, rows, 10.0 ** rng.uniform(-2, -0.2))
    parts["W_R"] = weight(rng, int(orders[1]), columns, columns, 1.0)
    if rng.random() < 0.3:
        parts["W_u"] = weight(rng, 1, m, m, 1.0)
    if rng.random() < 0.25:
        parts["remainder_left"], parts["remainder_right"] = (
            weight(rng, int(rng.integers(0, 3)), n, n, 0.05),
            gain(np.eye(m), 1.0),
        )
    problem = ObserverProblem(**parts)
    size = hinf_norm(problem.N, 1e-3)
    return problem if size < 0.9 else replace(problem, W_L=_times(problem.W_L, rng.uniform(0.2, 0.85) / size))


def _covariance(A: Array, B: Array) -> Array:
    P, step, power = B @ B.T, B @ B.T, A
    for _ in range(40):
        step = power @ P @ power.T
        P, power = P + step, power @ power
    return np.asarray(P)


def response(system: StateSpace, theta: Array) -> Array:
    """Transfer matrices at angles, by inversion."""
    n = system.n_states
    zeta = np.expm1(1j * theta)
    return np.asarray(
        system.C @ np.linalg.inv(zeta[:, None, None] * np.eye(n) - (system.A - np.eye(n))) @ system.B + system.D
    )


def attained(problem: ObserverProblem, K: StateSpace, theta: Array, rng: np.random.Generator) -> Array:
    """Power density of the error for the worst perturbations that are found, from the definition of the set; shape (k,)."""
    x, u, A, B, C = problem.output_scale, problem.input_scale, problem.nominal.A, problem.nominal.B, problem.C
    n, m = B.shape
    J = B if problem.injection is Injection.INPUT else np.eye(n)
    R = np.linalg.inv(np.expm1(1j * theta)[:, None, None] * np.eye(n) - (A - np.eye(n)))
    gains = response(K, theta)
    S = np.linalg.inv(np.eye(n) + R @ J @ gains @ C)
    W_p = np.diag(1 / x)[: problem.n_original or n]
    G = (R @ B) * u / x[:, None]  # scaled
    W_L, W_R, W_u = (response(w, theta) for w in (problem.W_L, problem.W_R, problem.input_weight))
    name = problem.form.value if isinstance(problem.form, Form) else problem.form
    W_u, S_x = np.broadcast_to(W_u, (len(theta), m, m)), W_p @ S * x
    at_input = name in ("input_multiplicative", "inverse_additive", "inverse_input_multiplicative")
    T = S_x @ (G @ W_L if at_input else W_L)
    M = W_R @ (W_u if name in ("additive", "input_multiplicative", "inverse_input_multiplicative") else G @ W_u)
    N = {
        "inverse_additive": lambda: W_R @ G @ W_L,
        "inverse_input_multiplicative": lambda: W_R @ W_L,
        "inverse_output_multiplicative": lambda: W_R @ W_L,
    }.get(name, lambda: np.zeros((len(theta), M.shape[-2], T.shape[-1])))()
    noise = W_p @ S @ R @ J @ gains * problem.noise
    rest = np.zeros((len(theta), T.shape[-2], m))
    if problem.remainder_left is not None and problem.remainder_right is not None:
        left, right = response(problem.remainder_left, theta), response(problem.remainder_right, theta) @ W_u
        U, _, _ = np.linalg.svd(np.swapaxes((S_x @ left).conj(), -1, -2), full_matrices=False)
        V, _, _ = np.linalg.svd(right, full_matrices=False)
        k = min(U.shape[-1], V.shape[-1])
        rest = S_x @ left @ (U[..., :k] @ np.swapaxes(V[..., :k], -1, -2).conj()) @ right
    found = np.zeros(len(theta))
    for start in range(3):
        X = rng.standard_normal((len(theta), T.shape[-1], M.shape[-2])) + 1j * rng.standard_normal(
            (len(theta), T.shape[-1], M.shape[-2])
        )
        delta = _contraction(np.swapaxes(T, -1, -2).conj() @ T @ X @ M @ np.swapaxes(M, -1, -2).conj() if start else X)
        for _ in range(CLIMB):
            inner = np.linalg.inv(np.eye(N.shape[-2]) - N @ delta)
            error = T @ delta @ inner @ M + rest
            found = np.maximum(found, np.sum(np.abs(error) ** 2, axis=(-2, -1)))
            outer = T @ np.linalg.inv(np.eye(N.shape[-1]) - delta @ N)
            delta = _contraction(np.swapaxes(outer, -1, -2).conj() @ error @ np.swapaxes(inner @ M, -1, -2).conj())
    return found + np.sum(np.abs(noise) ** 2, axis=(-2, -1))


def _contraction(X: Array) -> Array:
    U, _, Vh = np.linalg.svd(X, full_matrices=False)
    return np.asarray(U @ Vh * (1 - 1e-12))


def fine_grid(problem: ObserverProblem, K: StateSpace) -> Array:
    """Angles, dense around every pole."""
    loop = problem.error_system(K)
    systems = [loop, problem.W_L, problem.W_R, problem.input_weight, problem.nominal]
    poles = np.log(np.concatenate([s.poles() for s in systems]).astype(complex) + 1e-12)
    around = (
        np.abs(poles.imag)[:, None]
        + np.abs(poles.real)[:, None] * np.r_[-(2.0 ** np.arange(-3, 6)), 0, 2.0 ** np.arange(-3, 6)]
    ).ravel()
    return np.unique(np.concatenate([np.geomspace(1e-6, np.pi, POINTS), around[(around > 1e-6) & (around < np.pi)]]))


def least_mean(density: Array, theta: Array) -> float:
    """Root of the integral that the values on a grid imply at least, nearly: the smaller end of every interval."""
    return float(np.sqrt(np.sum(np.minimum(density[1:], density[:-1]) * np.diff(theta)) / np.pi))


def other_observers(
    problem: ObserverProblem, found: Synthesis, rng: np.random.Generator
) -> Iterator[tuple[ObserverProblem, StateSpace]]:
    """Observers of either injection that are not the one found."""
    n, m, q = problem.nominal.n_states, problem.nominal.n_inputs, len(problem.C)
    K = found.controller
    yield problem, gain(np.zeros((K.n_outputs, q)), 1.0)
    for _ in range(OTHERS):
        size = 10.0 ** rng.uniform(-3, 0)
        yield (
            problem,
            StateSpace(
                K.A,
                K.B * (1 + size * rng.standard_normal(K.B.shape)),
                K.C,
                K.D * (1 + size * rng.standard_normal(K.D.shape)),
                1.0,
            ),
        )
    for injection, rows, scale in (
        (Injection.STATE, n, problem.output_scale),
        (Injection.INPUT, m, problem.input_scale),
    ):
        same = replace(problem, injection=injection)
        best, least = np.zeros((rows, q)), np.inf
        for _ in range(OTHERS):
            tried = best + 10.0 ** rng.uniform(-2, 0) * scale[:, None] / problem.output_scale[:q] * rng.standard_normal(
                (rows, q)
            )
            value = value_of(same, gain(tried, 1.0))
            if value < least:
                best, least = tried, value
        yield same, gain(best, 1.0)


def value_of(problem: ObserverProblem, K: StateSpace) -> float:
    """Certified value; infinite where there is none."""
    try:
        return certify_errors(problem, problem.error_system(K))
    except SynthesisError:
        return np.inf


def run(count: int, seed: int) -> list[Tally]:
    """Try random problems."""
    upper = Tally(
        "worst_case_h2, certified value",
        "perturbations that climb at every frequency of a fine grid, from the definition of the set",
    )
    density = Tally(
        "worst_case_h2, lower bound",
        "certified values of other observers: none, perturbed, searched gains at the state and at the input",
    )
    gaps = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        problem = random_problem(rng)
        start = time.perf_counter()
        try:
            found = worst_case_h2(problem, max_order=ORDERS[k % len(ORDERS)], tolerance_db=3.0)
        except SynthesisError:
            upper.add("refused with a reason", time.perf_counter() - start)
            density.add("refused with a reason")
            continue
        except Exception as error:
            upper.add(f"traceback: {type(error).__name__}, problem {k}", time.perf_counter() - start, failed=True)
            continue
        seconds = time.perf_counter() - start
        theta = fine_grid(problem, found.controller)
        worst = least_mean(attained(problem, found.controller, theta, rng), theta)
        assert found.worst_case_h2 is not None
        false = worst > found.worst_case_h2 * (1 + 1e-6)
        upper.add(f"exceeded, problem {k}" if false else "holds", seconds, failed=false)
        if found.lower_bound is None:
            internal = any("Internal" in note for note in found.notes)
            density.add(
                f"false bound dropped, problem {k}" if internal else "none proven, with a note", failed=internal
            )
            continue
        gaps.append(found.gap_percent or 0.0)
        least = min(value_of(*other) for other in other_observers(problem, found, rng))
        false = found.lower_bound > min(least, found.worst_case_h2) * (1 + 1e-6)
        density.add(f"false bound, problem {k}" if false else "holds", failed=false)
    if gaps:
        density.note = f"gap to the certified value: median {np.median(gaps):.1f} %, nine of ten below {np.quantile(gaps, 0.9):.0f} %"
    return [upper, density]


if __name__ == "__main__":
    main("worst_case_h2", "Worst-case H2 observers", run, 500)
