"""The exact nominal among many units, against the number of units.

    OMP_NUM_THREADS=1 python -m pytest benchmarks/bench_nominal.py --benchmark-only
    OMP_NUM_THREADS=1 python benchmarks/bench_nominal.py        (prints times, memory and the fitted exponent)

Identifying a thousand simulated drives would take longer than the search by far, so that the models are made from a few: coupled lags with four outputs and
two inputs stand for identified models, and every unit is a random convex combination of twelve of them with a few percent of its own on poles and
gains, which keeps it stable (poles are moved in magnitude of their time constants, never across the unit circle).
"""

from __future__ import annotations

import resource
import time

import numpy as np
import pytest

from kros.core import StateSpace
from kros.core.frequency import log_grid
from kros.uncertainty import Form, bounds, choose_nominal, choose_nominals

DT, FREQS = 1e-3, 1000
COUNTS = (125, 250, 500, 1000)


def population(n_units: int, seed: int = 0) -> np.ndarray:
    """Responses, shape (unit, 1000, 4, 2)."""
    rng = np.random.default_rng(seed)
    corners = np.array([1.0, 5.0, 20.0, 80.0]) * np.exp(0.15 * rng.normal(size=(12, 4)))
    mixing = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    gains = rng.normal(size=(4, 2)) * (1 + 0.1 * rng.normal(size=(12, 4, 2)))
    share = rng.dirichlet(0.5 * np.ones(12), n_units)
    own = np.exp(0.02 * rng.normal(size=(n_units, 4)))
    poles = np.exp(-2 * np.pi * DT * np.exp(share @ np.log(corners)) * own)
    A = mixing @ (poles[:, :, None] * np.eye(4)) @ np.linalg.inv(mixing)
    B = (np.eye(4) - A) @ (np.einsum("nk,kij->nij", share, gains) * (1 + 0.02 * rng.normal(size=(n_units, 4, 2))))
    units = StateSpace(A, B, np.broadcast_to(np.eye(4), A.shape), np.zeros(B.shape), DT)
    freqs = log_grid(DT, FREQS)
    return np.concatenate([units[i : i + 50].frequency_response(freqs) for i in range(0, n_units, 50)])


@pytest.mark.parametrize("n_units", COUNTS)
def test_exact_nominal_among_many(benchmark, n_units: int) -> None:
    """One form by peak; the result is compared with all pairs where that is affordable."""
    G = population(n_units)
    form = Form.INVERSE_INPUT_MULTIPLICATIVE
    found = benchmark.pedantic(choose_nominal, (G, form), rounds=2, iterations=1)
    if n_units <= 125:
        assert found.index == int(np.argmin(bounds(form, G).max(axis=1)))
    benchmark.extra_info["evaluated"] = int(found.evaluated.sum())


@pytest.mark.parametrize("shape", ["4 x 2", "3 x 2"])
def test_six_forms_of_38_units(benchmark, shape: str) -> None:
    """The nominals of all forms."""
    G = population(38)[:, :, : int(shape[0])]
    found = benchmark.pedantic(choose_nominals, (G,), rounds=3, iterations=1)
    assert set(found) == set(Form)


def main() -> None:
    """Print times of all six forms by peak and by area, and the exponent of the growth."""
    for criterion in ("peak", "area"):
        seconds = []
        for n_units in COUNTS:
            G, best, evaluated = population(n_units), np.inf, []
            for _ in range(2):
                start = time.process_time()
                evaluated = [int(choose_nominal(G, form, criterion, freqs_hz=log_grid(DT, FREQS)).evaluated.sum()) for form in Form]
                best = min(best, time.process_time() - start)
            seconds.append(best)
            megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"{criterion}: {n_units:5d} units, six forms {best:7.2f} s, evaluated {evaluated}, at most {megabytes:.0f} MB", flush=True
            )
        print(f"{criterion}: time grows as N^{np.polyfit(np.log(COUNTS), np.log(seconds), 1)[0]:.2f}")


if __name__ == "__main__":
    main()
