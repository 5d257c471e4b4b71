"""Uncertainty weights side by side: kros, dkpy where it can be imported, and the entrywise fit of the paper.

    OMP_NUM_THREADS=1 python benchmarks/weights_beside_dkpy.py [--cache FOLDER] [--seeds 200 205]

For dkpy put the site-packages of an environment that has it on ``PYTHONPATH``; without it its columns are left out. Both fit the same
magnitudes at the same orders, with equal weight at all frequencies (by default dkpy weighs by the magnitude). kros fits continuous weights on
the unit circle that the bilinear map makes of the axis. Ratios are on grids 50 times denser than those of the fits.
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import outlier_rates
import paper_slsqp

from kros.core.lti import StateSpace
from kros.identify import edmd
from kros.identify.edmd import smallest_stabilising_alpha
from kros.lifting import Lifting
from kros.uncertainty import Cover, choose_nominal, fit_magnitude, fit_weight, optimal_cover, quantify_responses, quantify_systems, residual
from kros.uncertainty.bilinear import BilinearAxis
from kros.uncertainty.model import scale_system
from kros.uncertainty.weights.certificate import ResidualSystems
from kros.uncertainty.weights.weight import Weight

Array = npt.NDArray[Any]
HAS_DKPY = importlib.util.find_spec("dkpy") is not None
PAPER_ORDERS = ((1, 3), (3, 3))  # of the Koopman weights of the paper's Figure 8
FORMS = ("inverse_additive",)
OMEGA = np.geomspace(1e-2, 1e2, 100)
DT = outlier_rates.PERIOD_S


def clocked(work: Callable[[], Any], repeat: int = 1, limit_s: float = 90.0) -> tuple[Any, float]:
    """Return a result, or the error, and the least processor time in seconds; work is stopped at a limit."""
    best = np.inf
    signal.signal(signal.SIGPROF, stop)
    for _ in range(repeat):
        start = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        try:
            result = work()
        except Exception as error:
            result = error
        signal.setitimer(signal.ITIMER_PROF, 0)
        best = min(best, time.process_time() - start)
    return result, best


def stop(*_: Any) -> None:
    """End the work that takes too long."""
    raise TimeoutError("stopped, no result in time")


def kros_fit(omega: Array, magnitude: Array, order: int) -> Callable[[Array], Array]:
    """Return the magnitude of the fit at any omega."""
    axis = BilinearAxis.over(omega / (2 * np.pi))
    system = axis.continuous(fit_magnitude(axis.discrete_hz(omega / (2 * np.pi)), magnitude, axis.period_s, order=order).system)
    return lambda w: np.abs(system.frequency_response(w / (2 * np.pi))[:, 0, 0])


def dkpy_fit(omega: Array, magnitude: Array, order: int) -> Callable[[Array], Array]:
    """Return the magnitude of dkpy's fit at any omega."""
    import dkpy

    system = dkpy.fit_uncertainty_weight(magnitude[:, None, None], omega, [order], weight=np.ones((len(omega), 1)))
    return lambda w: np.abs(np.atleast_1d(system(1j * w)))


def overbound_db(fitted: Any, omega: Array, magnitude: Array) -> str:
    """Return the largest overbound and the smallest ratio at the grid, or why there is none."""
    if isinstance(fitted, Exception):
        return f"fails: {str(fitted)[:50]}"
    ratio = fitted(omega) / magnitude
    return f"{20 * np.log10(ratio.max()):.3f} dB" + (f", short by {20 * np.log10(1 / ratio.min()):.3f} dB" if ratio.min() < 0.9999 else "")


def cases() -> dict[str, tuple[Array, Array, int]]:
    """Magnitudes whose best bound is known (themselves), and a resonant one."""
    s = 1j * OMEGA
    resonances = sum(1 / (s**2 + 2 * 0.02 * w * s + w**2) * w**2 for w in (0.1, 1.0, 10.0))
    return {
        "pole at 0.1": (OMEGA, np.abs((s + 1) / (s + 0.1)), 1),
        "1 / (10 s + 1) + 0.01": (OMEGA, np.abs(1 / (10 * s + 1) + 0.01), 1),
        "poles 0.1 and 10": (OMEGA, np.abs((s + 1) ** 2 / ((s + 0.1) * (s + 10))), 2),
        "three resonances": (OMEGA, np.abs(resonances + 0.01), 6),
    }


def magnitudes() -> Iterator[tuple[str, tuple[Array, Array, int]]]:
    """All magnitudes of the first table; dkpy's covers take it a while."""
    yield from cases().items()
    if HAS_DKPY:
        yield from dkpy_covers().items()


def dkpy_covers() -> dict[str, tuple[Array, Array, int]]:
    """Optimal weights of dkpy's two examples, by dkpy, at the orders of the examples."""
    import dkpy

    found: dict[str, tuple[Array, Array, int]] = {}
    first = dkpy.example_multimodel_uncertainty()
    E = dkpy.compute_uncertainty_residual_response(
        first["complex_response_nominal"], first["complex_response_offnominal_list"], {"inverse_additive"}
    )["inverse_additive"]
    sides = dkpy.compute_uncertainty_weight_response(E, "diagonal", "diagonal")
    for side, values, orders in zip(("left", "right"), sides, ((4, 5), (3, 5)), strict=True):
        for i, order in enumerate(orders):
            found[f"multi-model, {side} {i + 1}"] = first["omega"], np.abs(values[:, i, i]), order
    second = dkpy.example_aircraft_actuator_uncertainty()
    E = dkpy.compute_uncertainty_residual_response(
        second["response_actuator_nominal"], second["response_actuator_offnominal"], {"multiplicative_input"}
    )["multiplicative_input"]
    left = dkpy.compute_uncertainty_weight_response(E, "scalar", "identity")[0]
    found["aircraft actuator"] = second["omega"], np.abs(left[:, 0, 0]), 1
    return found


def print_magnitudes(limit_s: float) -> None:
    """First table: one magnitude at one order."""
    print("| magnitude | order | kros | dkpy | kros (s) | dkpy (s) | times faster |\n|---|---|---|---|---|---|---|")
    for name, (omega, magnitude, order) in magnitudes():
        ours, seconds = clocked(lambda o=omega, m=magnitude, n=order: kros_fit(o, m, n), 3)
        row = [name, order, overbound_db(ours, omega, magnitude)]
        if HAS_DKPY:
            theirs, long = clocked(lambda o=omega, m=magnitude, n=order: dkpy_fit(o, m, n), limit_s=limit_s)
            row += [overbound_db(theirs, omega, magnitude), f"{seconds:.3f}", f"{long:.2f}", f"{long / seconds:.0f}"]
        else:
            row += ["not installed", f"{seconds:.3f}", "", ""]
        print("| " + " | ".join(map(str, row)) + " |", flush=True)


def print_examples(limit_s: float) -> None:
    """Second table: dkpy's multi-model example from responses to weights, in the form of the example."""
    if not HAS_DKPY:
        print("dkpy cannot be imported: its example is left out.")
        return
    import control
    import dkpy

    example = dkpy.example_multimodel_uncertainty()
    omega, G, Gp = (example[k] for k in ("omega", "complex_response_nominal", "complex_response_offnominal_list"))
    dense = np.geomspace(omega[0], omega[-1], 50 * len(omega))

    def at(system: Any) -> Array:
        return np.moveaxis(control.frequency_response(system, dense).complex, -1, 0)

    nominal, units = at(example["system_nominal"]), np.array([at(s) for s in example["system_offnominal_list"]])
    measured = "mean and largest excess over the optimal cover, largest ratio between points"
    print(f"| form | kros: {measured} | dkpy | kros (s) | dkpy (s) | times faster |\n|---|---|---|---|---|---|")
    for form in FORMS:
        E = residual(form, nominal, units)

        def facts(left: Array, right: Array, E: Array = E) -> str:
            ratio = np.linalg.norm(np.linalg.inv(left) @ E @ np.linalg.inv(right), 2, axis=(-2, -1)).max()
            over = Cover(*(np.abs(np.einsum("fii->fi", w)) for w in (left, right))).cost_db() - optimal_cover(E).cost_db()
            return f"{over.mean():.2f} and {over.max():.2f} dB, {ratio:.4f}"

        def ours(form: str = form) -> Any:
            return quantify_responses(np.concatenate([G[None], Gp]), omega / (2 * np.pi), form, nominal=0, max_order=5, tolerance_db=0.0)

        def theirs(form: str = form) -> Any:
            E = dkpy.compute_uncertainty_residual_response(G, Gp, {form})[form]
            sides = dkpy.compute_uncertainty_weight_response(E, "diagonal", "diagonal")
            return [dkpy.fit_uncertainty_weight(w, omega, 5, weight=np.ones((len(omega), 2))) for w in sides]

        found, seconds = clocked(ours, 2)
        other, long = clocked(theirs, limit_s=4 * limit_s)
        weight = found.weight
        states = weight.left.n_states + weight.right.n_states
        mine = facts(*(w.frequency_response(dense / (2 * np.pi)) for w in (weight.left, weight.right)))
        yours = f"fails: {str(other)[:50]}" if isinstance(other, Exception) else facts(*(at(w) for w in other))
        print(f"| {form}, {states} states, dkpy 20 | {mine} | {yours} | {seconds:.2f} | {long:.1f} | {long / seconds:.0f} |", flush=True)


def print_peaks(limit_s: float) -> None:
    """Third table: light resonances whose peaks no grid point meets; the largest ratio to the weight on a grid of 200 000 points."""
    tops = np.array([1.0, 0.93, 0.97, 1.04, 1.09])
    A = np.zeros((len(tops), 2, 2))
    A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = 1.0, -(tops**2), -0.004 * tops
    B, C = np.tile([[0.0], [1.0]], (len(tops), 1, 1)), np.stack([tops[:, None] ** 2, np.zeros((len(tops), 1))], axis=-1)
    units = StateSpace(A, B, C, np.linspace(0.01, 0.02, len(tops)).reshape(-1, 1, 1), 0.0)
    dense = np.geomspace(OMEGA[0], OMEGA[-1], 200_000)

    def largest(omega: Array) -> Array:
        response = units.frequency_response(omega / (2 * np.pi))[:, :, 0, 0]
        return np.abs(response - response[0]).max(axis=0)

    model = quantify_systems(units, "additive", OMEGA / (2 * np.pi), nominal=0, max_order=6)
    ratio = largest(dense) / np.abs(model.weight.left.frequency_response(dense / (2 * np.pi))[:, 0, 0])
    print(f"peaks between grid points: kros {ratio.max():.4f}", end="")
    if HAS_DKPY:
        found, _ = clocked(lambda: dkpy_fit(OMEGA, largest(OMEGA), 6), limit_s=limit_s)
        print(f"; dkpy {found if isinstance(found, Exception) else format((largest(dense) / found(dense)).max(), '.4f')}", end="")
    print(flush=True)


def drives(seed: int, cache: Path) -> tuple[StateSpace, int]:
    """Koopman models of 12 simulated drives, in units of the population's ranges, and the best nominal."""
    factors = outlier_rates.factors_of(seed, argparse.Namespace(cache=cache, episodes=5, seconds=8.0))
    rows = [*range(outlier_rates.N_UNITS)]
    phase = {"phase": outlier_rates.phases(factors, rows)}
    raw = outlier_rates.Factor(*(factors[f"{x}_noload"][rows] for x in ("R", "peak", "n")))
    kinds = (outlier_rates.KOOPMAN, Lifting(outlier_rates.STATES))
    found = [outlier_rates.lifted_factor(raw, outlier_rates.KOOPMAN, phase, kind) for kind in kinds]
    alpha = outlier_rates.ALPHA_FACTOR * smallest_stabilising_alpha([(f.R, k.n_lifted) for k, f in zip(kinds, found, strict=True)])
    n = kinds[0].n_lifted
    matrices = edmd(found[0].R, n, alpha)
    ranges = found[0].peak.max(axis=0)
    system = StateSpace(matrices.A, matrices.B, np.broadcast_to(np.eye(n), matrices.A.shape), np.zeros(matrices.B.shape), DT)
    units = scale_system(system, ranges[:n], ranges[n:])
    return units, choose_nominal(units.frequency_response(outlier_rates.grid()), "inverse_input_multiplicative").index


def row(name: str, states: int, W: Array, allowed: Array, E: Array, excess: float | None, seconds: float) -> str:
    """Facts of one weight on the dense grid: entries allowed, and the volume once it covers a full perturbation."""
    entries = np.abs(E).max(axis=0)
    over = 20 * np.log10(allowed / entries)
    volume = 20 * np.log10(np.abs(np.linalg.det(W))).mean() / 2 + 20 * np.log10(max(excess, 1e-300) if excess else 1.0)
    facts = [
        f"{over.mean():.1f}",
        f"{over.max():.1f}",
        f"{(entries / allowed).max():.4g}",
        f"{excess:.4g}",
        f"{volume:.1f}",
        f"{seconds:.1f}",
    ]
    return f"| {name} | {states} | " + " | ".join(facts) + " |"


def print_drives(seeds: list[int], cache: Path) -> None:
    """Last table: weights for residuals of simulated drives, against the paper's fit at the paper's orders and at order 3."""
    head = "seed, weights | states | mean overbound of entries (dB) | largest (dB) | largest entry ratio | full perturbation: sigma_max"
    print(f"| {head} | mean log size once it covers (dB) | s |\n|---|---|---|---|---|---|---|---|")
    freqs, dense = outlier_rates.grid(), np.geomspace(5e-4, 500.0, 50000)
    for seed in seeds:
        units, best = drives(seed, cache)
        systems = ResidualSystems("inverse_input_multiplicative", units[best], units)

        def residuals(f: Array, units: StateSpace = units, best: int = best) -> Array:
            return residual("inverse_input_multiplicative", units[best].frequency_response(f), units.frequency_response(f))

        E, coarse = residuals(dense), np.abs(residuals(freqs)).max(axis=0)
        for label, orders in (("paper's orders", PAPER_ORDERS), ("order 3", ((3, 3), (3, 3)))):
            omega = 2 * np.pi * freqs
            fits, seconds = clocked(
                lambda o=orders, c=coarse, w=omega: [[paper_slsqp.fit(w, c[:, i, j], o[i][j]) for j in range(2)] for i in range(2)]
            )
            for how in ("before sampling", "zoh", "bilinear"):
                W = np.array([[at_dense(fit, dense, how) for fit in line] for line in fits]).transpose(2, 0, 1)
                excess = np.linalg.norm(np.linalg.pinv(W) @ E, 2, axis=(-2, -1)).max()
                print(row(f"{seed}, paper, {label}, {how}", int(np.sum(orders)), W, np.abs(W), E, excess, seconds), flush=True)
        for structure in ("scalar", "diagonal", "entrywise"):
            (weight, _), seconds = clocked(
                lambda s=structure, r=residuals, x=systems: fit_weight(r, freqs, DT, structure=s, systems=x, tolerance_db=1.0)
            )
            print(row(f"{seed}, kros, {structure}", *kros_facts(weight, E, dense), seconds), flush=True)


def kros_facts(weight: Weight, E: Array, dense: Array) -> tuple[int, Array, Array, Array, float]:
    """States, weights as one matrix of their volume, entries allowed, residuals and the excess with a full perturbation."""
    left, right = weight.left.frequency_response(dense), weight.right.frequency_response(dense)
    states = weight.left.n_states + weight.right.n_states
    if weight.perturbation.value == "diagonal":
        W = left @ right
        return states, W, np.abs(W), E, float(np.linalg.norm(np.linalg.inv(W) @ E, 2, axis=(-2, -1)).max())
    allowed = np.linalg.norm(left, axis=2)[:, :, None] * np.linalg.norm(right, axis=1)[:, None, :]
    ratio = float(np.linalg.norm(np.linalg.inv(left) @ E @ np.linalg.inv(right), 2, axis=(-2, -1)).max())
    return states, left @ right, allowed, E, ratio


def at_dense(fitted: tuple[Array, Array, float], freqs_hz: Array, how: str) -> Array:
    """Response of one entry of the paper's weights."""
    if how == "before sampling":
        return paper_slsqp.response(fitted, 2 * np.pi * freqs_hz)
    return paper_slsqp.sampled(fitted, DT, how).frequency_response(freqs_hz)[:, 0, 0]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[200, 205])
    parser.add_argument("--tables", nargs="+", default=["magnitudes", "examples", "drives"], choices=["magnitudes", "examples", "drives"])
    parser.add_argument("--limit", type=float, default=90.0, help="processor seconds after which a fit of dkpy is stopped")
    parser.add_argument("--cache", type=Path, default=Path("outlier_rates"))
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    kros_fit(OMEGA, np.ones_like(OMEGA) / (1 + OMEGA), 1)  # imports SciPy's solver and mpmath
    if "magnitudes" in options.tables:
        print_magnitudes(options.limit)
    if "examples" in options.tables:
        print_examples(options.limit)
        print_peaks(options.limit)
    if "drives" in options.tables:
        print_drives(options.seeds, options.cache)


if __name__ == "__main__":
    main()
