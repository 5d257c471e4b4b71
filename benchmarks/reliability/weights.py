"""Random populations through `quantify`, and their sampled responses through `quantify`.

The truth is computed here, from the matrices of the units and the formulas of the forms: responses by linear solves, residuals by
pseudo-inverses, ratios on a dense grid that looks around every pole of units, nominal and weights, then three times more finely around the
highest ratios.
"""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from campaign import LONGEST_S, Tally, main

from kros.core import KrosError, StateSpace
from kros.uncertainty import Form, quantify

Array = np.ndarray[Any, Any]
KINDS = ("generic", "lightly damped", "stiff", "nearly identical", "identical", "static", "delayed")
SHAPES = ((1, 1),) * 6 + ((2, 1), (1, 2), (2, 2)) * 2 + ((3, 2), (2, 3))
ROUNDING = 1e-7  # of the ratio: products and inverses in double precision
TIGHT_DB = 0.02  # rounding of what is compared with the tolerance
EPS = 1e-15
REGULAR = 1e8  # condition up to which the least-squares residual of the forms is well defined in double precision


@dataclass
class Case:
    """One population and how it is asked to be quantified."""

    kind: str
    units: list[StateSpace]
    form: Form
    max_order: int
    tolerance_db: float
    freqs_hz: Array


def make(rng: np.random.Generator) -> Case:
    """Draw a case."""
    kind, (p, m), dt = (
        KINDS[rng.integers(len(KINDS))],
        SHAPES[rng.integers(len(SHAPES))],
        float(rng.choice([1.0, 0.01])),
    )
    continuous = kind != "delayed" and rng.random() < 0.15
    base, count = _modes(rng, kind), int(rng.integers(2, 9))
    spread = {"identical": 0.0, "nearly identical": 10.0 ** rng.uniform(-10, -4)}.get(
        kind, 10.0 ** rng.uniform(-2.5, -0.3)
    )
    B, C, D = (
        rng.standard_normal((len(base) * 2, m)),
        rng.standard_normal((p, len(base) * 2)),
        rng.standard_normal((p, m)),
    )
    D = D * rng.choice([1e-3, 0.1, 1.0])
    units = [_unit(rng, kind, base, B, C, D, spread, dt, continuous) for _ in range(count)]
    top = 0.4999 / dt
    freqs = np.geomspace(top * 10.0 ** -rng.uniform(2, 5), top, int(rng.integers(10, 30)))
    form = list(Form)[rng.integers(6)]
    return Case(kind, units, form, 1 + int(8 * rng.random() ** 3), float(rng.choice([0.5, 1.0, 3.0])), freqs)


def _modes(rng: np.random.Generator, kind: str) -> list[tuple[float, float]]:
    """Radius and angle of every pair of poles; angle zero for two real ones."""
    if kind == "static":
        return []
    count = int(rng.integers(1, 3))
    if kind == "lightly damped":
        return [(1 - 10.0 ** rng.uniform(-4, -2), rng.uniform(0.01, 3.1)) for _ in range(count)]
    if kind == "stiff":
        return [(1 - 10.0 ** rng.uniform(-6, -0.3), 0.0) for _ in range(count + 1)]
    return [(rng.uniform(0.3, 0.99), rng.uniform(0.0, 3.0) * (rng.random() < 0.5)) for _ in range(count)]


def _unit(
    rng: np.random.Generator,
    kind: str,
    base: list[tuple[float, float]],
    B: Array,
    C: Array,
    D: Array,
    spread: float,
    dt: float,
    s: bool,
) -> StateSpace:
    n, m = 2 * len(base), B.shape[1]
    A, gains = np.zeros((n, n)), np.ones(n)
    for k, (r, angle) in enumerate(base):
        far = (1 - r) * np.exp(spread * rng.standard_normal())
        radius = 1 - min(far, 0.9)
        turn = angle * (1 + 0.1 * spread * rng.standard_normal())
        part = slice(2 * k, 2 * k + 2)
        A[part, part] = radius * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        if angle == 0:
            A[part, part] = np.diag([radius, radius * (1 - 0.3 * far)])
        gains[part] = 1 - r
    Ck = C * gains * (1 + spread * rng.standard_normal(C.shape))
    Dk = D * (1 + spread * rng.standard_normal(D.shape))
    if kind == "delayed":
        delay = int(rng.integers(1, 4))
        shift = np.eye(delay * m, k=-m)
        first, last = np.eye(delay * m)[:, :m], np.eye(delay * m)[-m:]
        A = np.block([[A, B @ last], [np.zeros((delay * m, n)), shift]])
        Ck, B, Dk = np.hstack([Ck, Dk @ last]), np.vstack([np.zeros_like(B), first]), np.zeros_like(Dk)
    if not s:
        return StateSpace(A, B, Ck, Dk, dt)
    inverse = np.linalg.inv(A + np.eye(n))
    return StateSpace(
        2 / dt * inverse @ (A - np.eye(n)), 2 / dt * inverse @ B, 2 * Ck @ inverse / 1.0, Dk - Ck @ inverse @ B, 0.0
    )


def response(system: StateSpace, freqs_hz: Array) -> Array:
    """Response of one system, by linear solves."""
    s = 2j * np.pi * freqs_hz
    shift = np.exp(s * system.dt) if system.dt > 0 else s
    inner = np.linalg.solve(shift[:, None, None] * np.eye(system.n_states) - system.A, system.B + 0j)
    return system.C @ inner + system.D


def truth(form: Form, G: Array, Gp: Array) -> tuple[Array, Array]:
    """Residual and what it does not rebuild, without what rounding may make of them; zero where they are not well defined."""
    E, R, known = formulas(form, G, Gp)
    sizes = [np.linalg.norm(x, 2, axis=(-2, -1)) for x in (G, Gp)]
    condition = 1.0 if form is Form.ADDITIVE else np.maximum(np.linalg.cond(G), np.linalg.cond(Gp))
    units = {"additive": sizes[1], "inverse_additive": 1 / np.maximum(sizes[0], 1e-300)}.get(
        form.value, np.ones_like(sizes[1])
    )
    return tuple(
        np.where(known[:, None, None], _shrunk(x, EPS * condition * u), 0.0) for x, u in ((E, units), (R, sizes[1]))
    )  # type: ignore[return-value]


def _shrunk(x: Array, noise: Array) -> Array:
    size = np.linalg.norm(x, 2, axis=(-2, -1))
    return x * np.maximum(1 - noise / np.maximum(size, 1e-300), 0.0)[:, None, None]


def formulas(form: Form, G: Array, Gp: Array) -> tuple[Array, Array, Array]:
    """Residual, what it does not rebuild, and where both are well defined."""
    diff, one, invert = Gp - G, np.eye, np.linalg.pinv
    known = np.ones(G.shape[0], bool)
    if form is Form.ADDITIVE:
        return diff, np.zeros_like(diff), known
    inverted = {"input_multiplicative": [G], "output_multiplicative": [G], "inverse_additive": [G, Gp]}.get(
        form.value, [Gp]
    )
    for plant in inverted:
        known &= np.linalg.cond(plant) < REGULAR
    if form is Form.INPUT_MULTIPLICATIVE:
        E = invert(G) @ diff
        return E, Gp - G @ (one(E.shape[-1]) + E), known
    if form is Form.OUTPUT_MULTIPLICATIVE:
        E = diff @ invert(G)
        return E, Gp - (one(E.shape[-1]) + E) @ G, known
    if form is Form.INVERSE_ADDITIVE:
        E = invert(Gp) @ diff @ invert(G)
        inner = one(G.shape[-1]) - E @ G
    elif form is Form.INVERSE_INPUT_MULTIPLICATIVE:
        E = invert(Gp) @ diff
        inner = one(E.shape[-1]) - E
    else:
        E = diff @ invert(Gp)
        inner = one(E.shape[-1]) - E
    known &= np.linalg.cond(inner) < REGULAR
    inner = np.where(known[:, None, None], inner, one(inner.shape[-1]))
    built = np.linalg.solve(inner, G) if form is Form.INVERSE_OUTPUT_MULTIPLICATIVE else G @ np.linalg.inv(inner)
    return E, Gp - built, known


def dense(case: Case, systems: list[StateSpace]) -> Array:
    """Frequencies around every pole, and between."""
    dt = systems[0].dt
    poles = np.concatenate([s.poles().astype(complex).ravel() for s in systems] + [np.zeros(0, complex)])
    if dt > 0:
        poles = np.log(poles[np.abs(poles) > 1e-6]) / dt
    reach = np.array([0.0, 0.1, 0.3, 1.0, 3.0, 10.0])
    around = np.abs(poles.imag[:, None]) + np.abs(poles.real)[:, None] * np.concatenate([-reach, reach])
    top = 0.5 / dt if dt > 0 else case.freqs_hz[-1] * 10
    low = case.freqs_hz[0] / (10 if dt > 0 else 1)
    found = np.concatenate([np.geomspace(low, top, 250), case.freqs_hz, (around / (2 * np.pi)).ravel()])
    return np.unique(found[(found >= low) & (found <= top)])


def largest(ratio: Callable[[Array], Array], freqs_hz: Array) -> tuple[float, float]:
    """Largest ratio and its frequency, refined around the highest local maxima."""
    values = ratio(freqs_hz)
    best, at = float(values.max()), float(freqs_hz[values.argmax()])
    tops = np.argsort(-values)[:6]
    spans = [(freqs_hz[max(i - 1, 0)], freqs_hz[min(i + 1, len(freqs_hz) - 1)]) for i in tops]
    for _ in range(3):
        points = [np.linspace(*span, 17) for span in spans]
        found = ratio(np.concatenate(points)).reshape(len(spans), 17)
        if found.max() > best:
            row = int(found.max(axis=1).argmax())
            best, at = float(found.max()), float(points[row][found[row].argmax()])
        spans = [(x[max(v.argmax() - 1, 0)], x[min(v.argmax() + 1, 16)]) for x, v in zip(points, found, strict=True)]
    return best, at


def excess(weight: Any, E: Array, freqs_hz: Array) -> Array:
    """Largest ratio of residuals (unit, frequency, p', m') to a weight at every frequency."""
    left, right = response(weight.left, freqs_hz), response(weight.right, freqs_hz)
    nothing = np.abs(left).max(axis=(1, 2)) == 0
    eye = np.eye(left.shape[1])
    found = np.linalg.solve(np.where(nothing[:, None, None], eye, left), E) @ np.linalg.inv(right)
    size = np.linalg.norm(found, 2, axis=(-2, -1)).max(axis=0)
    return np.where(nothing & (np.abs(E).max(axis=(0, 2, 3)) > 1e-300), np.inf, size)


def loose_db(weight: Any, E: Array, freqs_hz: Array) -> float | None:
    """Overbound over the optimal cover where that is known in closed form: one entry."""
    if E.shape[2:] != (1, 1):
        return None
    sizes = np.linalg.norm(E, 2, axis=(-2, -1)).max(axis=0)
    left, right = response(weight.left, freqs_hz), response(weight.right, freqs_hz)
    allowed = np.abs(left[:, 0, 0] * right[:, 0, 0])
    some = sizes > 0
    return float(20 * np.log10(allowed[some] / sizes[some]).max()) if some.any() else 0.0


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Interrupt what takes too long."""

    def stop(*_: Any) -> None:
        raise TimeoutError

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def models(case: Case) -> tuple[str, bool]:
    """Judge `quantify`: the bound between grid points, that of the remainder, and the statement about the tolerance."""
    options: dict[str, Any] = {
        "max_order": case.max_order,
        "tolerance_db": case.tolerance_db,
    }
    found = quantify(case.units, case.form, case.freqs_hz, **options)
    nominal, weight, remainder = found.scaled_nominal(), found.weight, found.remainder
    shown = [weight.left, weight.right] + ([remainder.left, remainder.right] if remainder else [])

    def both(freqs_hz: Array) -> tuple[Array, Array]:
        G = response(nominal, freqs_hz)
        parts = [truth(case.form, G, response(u, freqs_hz)) for u in case.units]
        return np.array([E for E, _ in parts]), np.array([R for _, R in parts])

    if not all(w.is_stable() for w in shown):
        return "unstable weight", True
    grid = dense(case, [*case.units, nominal, *shown])
    peak, _ = largest(lambda f: excess(weight, both(f)[0], f), grid)
    if peak > 1 + ROUNDING:
        return f"weight exceeded between grid points ({peak:.3g})", True
    if remainder is not None:
        peak, _ = largest(lambda f: excess(remainder, both(f)[1], f), grid)
        if peak > 1 + ROUNDING:
            return f"remainder exceeded between grid points ({peak:.3g})", True
    elif np.abs(both(grid)[1]).max() > 1e-6 * max(np.abs(response(u, grid)).max() for u in case.units):
        return "remainder missing", True
    return _tolerance(case, weight, both(found.freqs_hz)[0], found.freqs_hz)


def responses(case: Case) -> tuple[str, bool]:
    """Judge `quantify`: the bound at the frequencies given, and the statement about the tolerance."""
    given = np.array([response(u, case.freqs_hz) for u in case.units])
    options: dict[str, Any] = {"max_order": case.max_order, "tolerance_db": case.tolerance_db}
    found = quantify(given, case.form, case.freqs_hz, sample_period_s=case.units[0].dt, **options)
    parts = [truth(case.form, found.nominal_response, G) for G in given]
    E, R = np.array([E for E, _ in parts]), np.array([R for _, R in parts])
    if excess(found.weight, E, case.freqs_hz).max() > 1 + ROUNDING:
        return f"weight exceeded at a given frequency ({excess(found.weight, E, case.freqs_hz).max():.3g})", True
    if found.remainder is not None and excess(found.remainder, R, case.freqs_hz).max() > 1 + ROUNDING:
        return f"remainder exceeded at a given frequency ({excess(found.remainder, R, case.freqs_hz).max():.3g})", True
    return _tolerance(case, found.weight, E, case.freqs_hz)


def _tolerance(case: Case, weight: Any, E: Array, freqs_hz: Array) -> tuple[str, bool]:
    loose = loose_db(weight, E, freqs_hz)
    if loose is None:
        return "bound holds", False
    within = weight.overbound_db_max <= case.tolerance_db
    if within and loose > case.tolerance_db + TIGHT_DB:
        return f"said to be within the tolerance and {loose:.2f} dB loose", True
    if not within and loose < case.tolerance_db - TIGHT_DB and E.shape[2:] == (1, 1):
        return "said to be beyond the tolerance and is within", True
    return "bound holds, " + ("within" if within else "said to be beyond") + " the tolerance", False


def judged(judge: Callable[[Case], tuple[str, bool]], case: Case) -> tuple[str, bool]:
    """Judge one case; a refusal needs a reason, and nothing else may be raised."""
    try:
        with limited(2 * LONGEST_S):
            return judge(case)
    except KrosError as error:
        return f"refused: {str(error).split(':')[0]}", False
    except TimeoutError:
        return "hang", True
    except Exception as error:  # every traceback counts
        return f"traceback {type(error).__name__}: {str(error)[:60]}", True


def run(count: int, seed: int) -> list[Tally]:
    """Try `count` populations, and as many sets of responses."""
    logging.getLogger("kros").setLevel(logging.CRITICAL)
    bound = "own responses and residuals on a dense grid around all poles, refined around the largest ratios; seconds are of the processor"
    tallies = [
        Tally("populations of models through quantify", bound),
        Tally("sampled responses of them through quantify", "own residuals at the given frequencies"),
    ]
    for k in range(count):
        for tally, judge in zip(tallies, (models, responses), strict=True):
            case = make(np.random.default_rng([seed, k]))
            began = time.process_time()
            outcome, failed = judged(partial(judge), case)
            tally.add(outcome, time.process_time() - began, failed)
            if failed:
                name = (
                    f"{k} {case.kind} {case.units[0].D.shape} {case.form.value} {case.max_order} dt {case.units[0].dt}"
                )
                tally.note = (tally.note + "; " if tally.note else "") + f"{name}: {outcome}"
                logging.getLogger("campaign").warning("%s: %s", name, outcome)
    return tallies


if __name__ == "__main__":
    main("weights", "Uncertainty weights of random populations", run, 500)
