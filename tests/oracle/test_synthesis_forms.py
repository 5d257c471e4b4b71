"""All six forms: the interconnection is the perturbed plant, the bound holds for every perturbation and is close to
the worst one found."""

import numpy as np
import pytest

from kros.core import StateSpace, block_diagonal, gain, hinf_norm
from kros.synthesis import Injection, ObserverProblem, worst_case_h2
from kros.synthesis.generalized_plant import split
from kros.synthesis.problem.plants import generalized_plant
from kros.synthesis.worst_case.certificate import certify_errors, density
from kros.uncertainty import Form, rebuild, residual

DT, N, M = 0.05, 3, 2
FREQS = np.array([0.0, 0.03, 0.7, 3.0, 9.9])


def random_system(rng, p, m, order, radius=0.9):
    """A stable system whose largest gain is one."""
    A = rng.standard_normal((order, order))
    A *= radius / max(np.abs(np.linalg.eigvals(A)).max(), 1e-9)
    system = StateSpace(
        A, rng.standard_normal((order, m)), rng.standard_normal((p, order)), rng.standard_normal((p, m)), DT
    )
    size = hinf_norm(system) * (1 + 1e-6)
    return StateSpace(A, system.B, system.C / size, system.D / size, DT)


def scaled_by(system, factor):
    return StateSpace(system.A, system.B, system.C * factor, system.D * factor, system.dt)


def weight(rng, rows, columns, structure, order=1):
    if structure == "full":
        return random_system(rng, rows, columns, order + 1)
    one = random_system(rng, 1, 1, order)
    return block_diagonal([one if structure == "scalar" else random_system(rng, 1, 1, order) for _ in range(rows)])


def problem(form, seed=0, structure="full", injection=Injection.STATE, remainder=True, **changes):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((N, N))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    nominal = StateSpace(A, rng.standard_normal((N, M)), np.eye(N), np.zeros((N, M)), DT)
    rows, columns = Form(form).sizes(N, M)
    parts = {
        "nominal": nominal,
        "C": np.eye(N)[:1],
        "W_L": weight(rng, rows, rows, structure),
        "W_R": weight(rng, columns, columns, "diagonal" if structure == "diagonal" else structure)
        if structure != "scalar"
        else gain(np.eye(columns), DT),
        "input_scale": rng.uniform(0.5, 2, M),
        "output_scale": rng.uniform(0.5, 2, N),
        "noise": np.array([0.1]),
        "injection": injection,
        "form": form,
    }
    if structure == "full":
        parts |= {"W_u": random_system(rng, M, M, 2), "n_original": 2}
    if remainder:
        parts |= {
            "remainder_left": scaled_by(weight(rng, N, N, "full"), 0.2),
            "remainder_right": random_system(rng, M, M, 1),
        }
    case = ObserverProblem(**{**parts, **changes})
    if not case.form.inverse:
        return case
    return ObserverProblem(**{**parts, "W_L": scaled_by(parts["W_L"], 0.6 / hinf_norm(case.N)), **changes})


def observer(rng, case):
    """A filter that keeps the nominal loop stable."""
    rows = M if case.injection is Injection.INPUT else N
    K = random_system(rng, rows, 1, 2)
    for size in 0.3 ** np.arange(20):
        if case.error_system(scaled_by(K, size)).is_stable():
            return scaled_by(K, size)
    raise AssertionError


def perturbed(case, closed, delta):
    """The loop from (w1, n) to z1, scaled, with a causal perturbation from z2 to w2."""
    u = case.nominal.n_inputs + np.arange(case.W_L.n_inputs)
    z, y = np.split(np.arange(closed.n_outputs), [len(case.scaled[3])])
    w = np.setdiff1d(np.arange(closed.n_inputs), u)
    ins, outs = np.concatenate([w, u]), np.concatenate([z, y])
    ordered = StateSpace(closed.A, closed.B[:, ins], closed.C[outs], closed.D[np.ix_(outs, ins)], closed.dt)
    return split(ordered, len(w), len(z)).close(delta)


def brute_force(case, K, delta, freqs):
    """Response of ``W_p (x - x_hat)`` to (w1, n) from the definitions, frequency by frequency, in physical units."""
    z = np.exp(2j * np.pi * freqs * DT)
    A, B, C = case.nominal.A, case.nominal.B, case.C
    x_scale, u_scale = np.diag(case.output_scale), np.diag(case.input_scale)
    J = B if case.injection is Injection.INPUT else np.eye(N)
    out = []
    for k in range(len(freqs)):

        def at(system, k=k):
            return system.frequency_response(freqs[[k]])[0]

        R = np.linalg.inv(z[k] * np.eye(N) - A)
        G = np.linalg.inv(x_scale) @ R @ B @ u_scale
        E = at(case.W_L) @ at(delta) @ at(case.W_R)
        Gp = rebuild(case.form, G, E)
        u = u_scale @ at(case.input_weight)  # inputs of the machine per unit of w1
        x = x_scale @ Gp @ at(case.input_weight)
        # x_hat = R (B u + J K (C x + n - C x_hat))
        gain_ = R @ J @ at(K)
        left = np.linalg.inv(np.eye(N) + gain_ @ C)
        e_w1 = x - left @ (R @ B @ u + gain_ @ C @ x)
        e_n = -left @ gain_ @ np.diag(case.noise)
        W_p = np.diag(1 / case.output_scale)[: case.n_original]
        out.append(W_p @ np.hstack([e_w1, e_n]))
    return np.array(out)


@pytest.mark.parametrize("injection", [Injection.STATE, Injection.INPUT])
@pytest.mark.parametrize("form", Form)
def test_interconnection_is_the_perturbed_plant(form, injection):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        case = problem(form, seed, injection=injection)
        K = observer(rng, case)
        delta = random_system(rng, case.W_L.n_inputs, case.W_R.n_outputs, 2)
        closed = generalized_plant(case).close(case.to_scaled(K))
        found = perturbed(case, closed, delta)
        assert found.is_stable()
        expected = brute_force(case, K, delta, FREQS)
        assert found.frequency_response(FREQS) == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def contraction(x, b, a):
    U, _, Vh = np.linalg.svd((x[: a * b] + 1j * x[a * b :]).reshape(b, a), full_matrices=False)
    return U @ Vh


def worst_found(rng, T, N_, M_, norm="fro", noise=None, starts=15, steps=40):
    """Search over perturbations with orthonormal rows or columns: to the polar factor of the gradient, from many
    random starts, best kept."""
    b, a = T.shape[1], M_.shape[0]
    noise = np.zeros((len(T), 0)) if noise is None else noise
    best = 0.0
    for _ in range(starts):
        delta = contraction(rng.standard_normal(2 * a * b), b, a)
        for _ in range(steps):
            loop = np.linalg.inv(np.eye(a) - N_ @ delta)
            error = np.hstack([T @ delta @ loop @ M_, noise])
            best = max(best, np.linalg.norm(error, norm))
            if norm == 2:  # the gradient of the largest singular value
                U, s, Vh = np.linalg.svd(error)
                error = s[0] * np.outer(U[:, 0], Vh[0])
            left = T @ (np.eye(b) + delta @ loop @ N_)
            U, _, Vh = np.linalg.svd(
                left.conj().T @ error[:, : M_.shape[1]] @ (loop @ M_).conj().T, full_matrices=False
            )
            delta = U @ Vh
    return best


def noise_columns(case, response):
    return response[..., N + M : N + M + 1]


@pytest.mark.parametrize(("structure", "limit"), [("scalar", 1.01), ("diagonal", 1.2), ("full", 1.2)])
@pytest.mark.parametrize("form", Form)
def test_bound_against_the_worst_perturbation_found(form, structure, limit):
    """Never below, and close: at frequencies one by one, which is harder than for the norm."""
    rng = np.random.default_rng(5)
    case = problem(form, 5, structure, remainder=False, **({} if structure == "full" else {"n_original": 2}))
    K = observer(rng, case)
    freqs = np.array([0.5, 4.0])
    loop = case.error_system(K)
    response = loop.frequency_response(freqs)
    bound = np.sqrt(density(case, loop, freqs) - np.sum(np.abs(noise_columns(case, response)) ** 2, axis=(-2, -1)))
    for k in range(len(freqs)):
        at = freqs[[k]]
        loop_ = case.N.frequency_response(at)[0]
        assert case.form.inverse or not loop_.any()
        T = response[k][:, slice(0, M) if case.form.at_input else slice(M, M + N)] @ case.W_L.frequency_response(at)[0]
        found = worst_found(rng, T, loop_, case.M.frequency_response(at)[0])
        assert found <= bound[k] * (1 + 1e-9)
        assert bound[k] <= found * limit


@pytest.mark.parametrize("form", Form)
def test_designs_of_every_form_are_certified(form):
    case = problem(form, 1, "diagonal", remainder=False)
    found = worst_case_h2(case, max_order=0)
    loop = case.error_system(found.controller)
    assert found.lower_bound <= found.worst_case_h2 == pytest.approx(certify_errors(case, loop))
    assert loop.is_stable()


@pytest.mark.parametrize("form", Form)
def test_units_that_make_the_weights_are_below_the_bounds(form):
    """Weights from the residuals of random units; their true errors, without any knowledge of forms, stay below."""
    rng = np.random.default_rng(8)
    A = np.diag([0.9, 0.7])
    nominal = StateSpace(A, np.array([[0.3, 0.1], [-0.1, 0.4]]), np.eye(2), np.zeros((2, 2)), DT)
    A_p = A + 0.003 * rng.standard_normal((4, 2, 2))
    B_p = nominal.B * (1 + 0.015 * rng.standard_normal((4, 2, 2)))
    units = StateSpace(A_p, B_p, np.broadcast_to(np.eye(2), (4, 2, 2)), np.zeros((4, 2, 2)), DT)
    freqs = np.linspace(0, 0.5 / DT, 400)
    E = residual(form, nominal.frequency_response(freqs), units.frequency_response(freqs))
    size = float(np.linalg.norm(E, 2, axis=(-2, -1)).max()) * 1.001
    case = ObserverProblem(
        nominal, np.eye(2)[:1], gain(size * np.eye(2), DT), gain(np.eye(2), DT), [1, 1], [1, 1], [1e-3], form=form
    )
    found = worst_case_h2(case, max_order=0)
    loop = case.error_system(found.controller)
    S, noise = np.split(loop.frequency_response(freqs)[..., 2:], [2], axis=-1)
    differences = units.frequency_response(freqs) - nominal.frequency_response(freqs)
    errors = np.sum(np.abs(S @ differences) ** 2, axis=(-2, -1))
    white = np.sum(np.abs(noise) ** 2, axis=(-2, -1))

    def bound(problem):
        return density(problem, loop, freqs) - white

    assert np.all(errors <= bound(case))
    assert np.sqrt(np.trapezoid(errors.max(axis=0), freqs) * 2 * DT) < certify_errors(case, loop)
    small = ObserverProblem(
        nominal, case.C, gain(1e-3 * size * np.eye(2), DT), case.W_R, [1, 1], [1, 1], [1e-3], form=form
    )
    assert np.any(errors > bound(small))  # the check can fail
