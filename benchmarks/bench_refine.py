"""Population refinement: 38 units with 18 training episodes of 20 s, both kinds of models, one condition.

pytest benchmarks/bench_refine.py --benchmark-only
"""

import numpy as np
import pytest

from kros.data import split_episodes
from kros.identify import Factor, PhaseSpec, combine, find_segments, lifted_factor, reduce_episode, resolve_branches, unit_phase
from kros.identify.refine import refine_population
from kros.lifting import Lifting
from kros.plants import HarmonicDrivePopulation

STATES = ("position", "velocity", "current")
KOOPMAN = Lifting(STATES, ("sin(100*position + phase)",), ("phase",))


@pytest.fixture(scope="module")
def drives():
    population = HarmonicDrivePopulation(n_units=38, n_episodes=20, seconds=20.0, seed=0, conditions=("noload",)).simulate().population
    splits = split_episodes(population)
    keys = {unit: splits[unit, "noload"].train for unit in population.unit_ids}
    phases, factors = {}, []
    for unit, episodes in keys.items():
        data = [population.read(key) for key in episodes]
        segments = [s for v in data for s in find_segments(v[:, 0], v[:, 4], v[:, 1], population.sample_period_s, PhaseSpec())]
        phases[unit] = unit_phase(segments, unit)
        factors.append(combine(stack([reduce_episode(v[:, :3], v[:, 3:], KOOPMAN) for v in data])))
    calibration = resolve_branches(phases, population.unit_ids, PhaseSpec())
    parameters = {"phase": np.array([calibration.units[unit].phase_rad for unit in population.unit_ids])}
    return population, keys, stack(factors), parameters


def stack(factors):
    return Factor(*(np.stack([getattr(f, name) for f in factors]) for name in ("R", "peak", "n_samples")))


@pytest.mark.parametrize("lifting", [KOOPMAN, Lifting(STATES)], ids=["koopman", "linear"])
def test_refine_38_units(benchmark, drives, lifting):
    population, keys, factor, parameters = drives
    own = parameters if lifting.parameters else {}
    models = benchmark.pedantic(
        refine_population,
        args=(population, keys, lifting, own, lifted_factor(factor, KOOPMAN, parameters, lifting)),
        rounds=1,
    )
    assert models.spectral_radius.max() < 1
