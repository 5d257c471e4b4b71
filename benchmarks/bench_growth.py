"""How the cost of the stages of kros grows with units, samples, frequencies and lifted states; `make bench` fits the exponents."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import problems
import pytest
from problems import DT, GEAR

from kros.core.frequency import log_grid
from kros.identify import edmd, free_run
from kros.identify.factors import reduce_episode
from kros.identify.refine import refine_population
from kros.observer import run_observer
from kros.synthesis import h2, hinf
from kros.uncertainty import choose_nominal, fit_magnitude, quantify, residual, sigma_max
from kros.uncertainty.weights.cover import optimal_cover

FORM = "inverse_input_multiplicative"
Work = Callable[[], Any]


def episode(samples: int, lifted: int) -> Work:
    (x, u), lifting = problems.recording(samples), problems.wide(lifted)
    return lambda: reduce_episode(x, u, lifting)


def models(units: int, lifted: int) -> Work:
    R = np.stack([reduce_episode(*problems.recording(400, seed % 8), problems.wide(lifted)).R for seed in range(units)])  # type: ignore[call-arg]
    return lambda: edmd(R, lifted, 90.0)


def refinement(units: int) -> Work:
    """Simulated drives, three episodes of 5 s each, the linear model."""
    from kros.identify import unit_factors
    from kros.lifting import Lifting
    from kros.plants import HarmonicDrivePopulation

    linear = Lifting(problems.STATES)
    population = (
        HarmonicDrivePopulation(n_units=units, n_episodes=3, seconds=5.0, seed=0, conditions=("noload",))
        .simulate()
        .population
    )
    keys = {unit: [key for key in population.episodes if key.unit == unit] for unit in population.unit_ids}

    factor = unit_factors(population, keys, linear)
    return lambda: refine_population(population, keys, linear, {}, factor)


def runs(samples: int, episodes: int, lifted: int) -> Work:
    rng, lifting = np.random.default_rng(0), problems.wide(lifted)
    A, B = (
        np.tile(M, (episodes, 1, 1))
        for M in (0.5 * np.linalg.qr(rng.normal(size=(lifted, lifted)))[0], rng.normal(size=(lifted, 2)))
    )
    x0, u = 0.1 * rng.normal(size=(episodes, 3)), 0.1 * rng.normal(size=(episodes, samples, 2))
    return lambda: free_run(A, B, lifting, {}, x0, u)


def observed(samples: int, episodes: int) -> Work:
    rng, o = np.random.default_rng(0), problems.observer(GEAR, 4)
    y, u = 0.1 * rng.normal(size=(samples, episodes, 1)), 0.1 * rng.normal(size=(samples, episodes, 2))
    return lambda: run_observer(o, y, u, {"phase": np.zeros(episodes)})


def nominal(units: int, freqs: int) -> Work:
    G = problems.responses(units, freqs)
    return lambda: choose_nominal(G, FORM)


def pairs(units: int, freqs: int) -> Work:
    G = problems.responses(units, freqs)
    return lambda: [sigma_max(residual(FORM, one, G)) for one in G]


def response(units: int, freqs: int) -> Work:
    systems, grid = problems.lags(units), log_grid(DT, freqs)
    return lambda: systems.frequency_response(grid)


def cover(freqs: int) -> Work:
    G = problems.responses(20, freqs, outputs=2)
    return lambda: optimal_cover(G[1:] - G[0])


def magnitude(freqs: int) -> Work:
    grid = log_grid(DT, freqs)
    values = np.linalg.norm(problems.lags(1)[0].frequency_response(grid), 2, axis=(-2, -1))
    return lambda: fit_magnitude(grid, values, DT, max_order=4, tolerance_db=0.0)


def uncertain_model(units: int) -> Work:
    systems = problems.lags(units)
    return lambda: quantify(systems, max_order=3, tolerance_db=0.0)


CURVES: dict[str, dict[str, tuple[Callable[[int], Work], tuple[int, ...]]]] = {
    "units": {
        "identify: models from factors": (lambda n: models(n, 5), (40, 80, 160, 320)),
        "identify: refinement, linear": (refinement, (4, 8, 16)),
        "quantify: frequency responses": (lambda n: response(n, 500), (40, 80, 160, 320)),
        "quantify: the best nominal": (lambda n: nominal(n, 500), (125, 250, 500, 1000)),
        "quantify: all pairs of nominal and unit": (lambda n: pairs(n, 500), (10, 20, 40)),
        "quantify: an uncertain model": (uncertain_model, (10, 20, 40)),
        "evaluate: an observer": (lambda n: observed(1000, n), (100, 200, 400, 800)),
    },
    "samples": {
        "identify: factor of an episode": (lambda n: episode(n, 5), (10_000, 20_000, 40_000, 80_000)),
        "identify: free run": (lambda n: runs(n, 20, 5), (1000, 2000, 4000, 8000)),
        "evaluate: an observer": (lambda n: observed(n, 20), (1000, 2000, 4000, 8000)),
    },
    "frequencies": {
        "quantify: the best nominal": (lambda n: nominal(100, n), (250, 500, 1000, 2000)),
        "quantify: optimal cover": (cover, (250, 500, 1000, 2000)),
        "quantify: fit of a magnitude": (magnitude, (250, 500, 1000, 2000)),
    },
    "lifted states": {
        "identify: factor of an episode": (lambda n: episode(10_000, n), (12, 24, 48, 96)),
        "identify: models from factors": (lambda n: models(10, n), (12, 24, 48, 96)),
        "identify: free run": (lambda n: runs(500, 20, n), (12, 24, 48, 96)),
        "synthesize: H2 controller": (lambda n: partial(h2, problems.plant(n, 1.0)), (12, 24, 48, 96)),
        "synthesize: H-infinity optimum": (lambda n: partial(hinf, problems.plant(n, 1.0)), (6, 12, 24)),
    },
}


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize(
    ("against", "name", "size"),
    [(x, name, n) for x, rows in CURVES.items() for name, (_, sizes) in rows.items() for n in sizes],
)
def test_growth(benchmark: Any, against: str, name: str, size: int) -> None:
    work = CURVES[against][name][0](size)
    start = time.process_time()
    work()  # imports and caches
    seconds = time.process_time() - start
    benchmark.group = f"{name}, against {against}"
    benchmark.extra_info |= {"curve": name, "against": against, "size": size}
    benchmark.pedantic(
        work,
        rounds=int(np.clip(0.5 / max(seconds, 0.02), 2, 10)) if seconds < 1.0 else 1,
        iterations=max(1, int(0.02 / max(seconds, 1e-6))),
    )
