"""Time the uncertainty layer at the size of the paper's population: 38 units, 4 x 2 plants, 1000 frequencies.

Run with ``OMP_NUM_THREADS=1 python benchmarks/bench_uncertainty.py``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from kros.core import StateSpace
from kros.core.frequency import log_grid
from kros.uncertainty import choose_nominals, fit_magnitude, misfit, optimal_cover, quantify_systems, residual, score_outliers

UNITS, STATES, INPUTS, DT = 38, 4, 2, 1e-3


def population(seed: int = 0) -> StateSpace:
    """Stable lags coupled at random, spread by a few percent."""
    rng = np.random.default_rng(seed)
    poles = np.diag(np.exp(-2 * np.pi * np.array([1.0, 5.0, 20.0, 80.0]) * DT))
    mixing = np.eye(STATES) + 0.3 * rng.normal(size=(STATES, STATES))
    base = mixing @ poles @ np.linalg.inv(mixing)
    A = base - (np.eye(STATES) - base) * (0.05 * rng.normal(size=(UNITS, 1, 1)))
    B = (np.eye(STATES) - base) @ rng.normal(size=(STATES, INPUTS)) * (1 + 0.05 * rng.normal(size=(UNITS, STATES, INPUTS)))
    return StateSpace(A, B, np.broadcast_to(np.eye(STATES), A.shape), np.zeros(B.shape), DT)


def report(name: str, work: Callable[[], Any]) -> Any:
    """Run and print the time."""
    start = time.perf_counter()
    result = work()
    print(f"{name:60s} {time.perf_counter() - start:8.3f} s")
    return result


def main() -> None:
    """Run all timings."""
    units, freqs = population(), log_grid(DT)
    G = report("frequency responses", lambda: units.frequency_response(freqs))
    nominal = report("nominals of six forms", lambda: choose_nominals(G))
    for form, choice in nominal.items():
        E = residual(form, G[choice.index], G)
        report(f"{form.value}: optimal cover", lambda E=E: optimal_cover(E))
        report(f"{form.value}: misfit", lambda E=E, form=form, choice=choice: misfit(form, G[choice.index], G, E))
    target = nominal[next(iter(nominal))].bound
    fit_magnitude(freqs[::100], target[::100], DT, order=1)  # imports SciPy's solver and mpmath
    report("one magnitude fit, order 4", lambda: fit_magnitude(freqs, target, DT, order=4))
    report("outlier scores", lambda: score_outliers(G, freqs))
    model = report("quantify, inverse input multiplicative", lambda: quantify_systems(units))
    print(
        f"cover_max {model.cover_max:.9f}, overbound {model.overbound_db_max:.2f} dB, orders {model.weight.left_orders} {model.weight.right_orders}"
    )


if __name__ == "__main__":
    main()
