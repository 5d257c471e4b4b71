"""Estimates of many episodes, block by block."""

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data import Channel, EpisodeBatch, EpisodeKey, Role, from_arrays
from kros.evaluate import held_out
from kros.evaluate.held_out import HeldOut

STATES = Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE)
CHANNELS = (*STATES, Channel("u", Role.INPUT), Channel("v_true", Role.TRUTH, of="v"))


def population_of(count):
    rng = np.random.default_rng(0)
    episodes = {f"unit {i}": [np.cumsum(rng.normal(size=(600 + 70 * ((3 * i) % 5), 4)), axis=0)] for i in range(count)}
    return from_arrays(episodes, CHANNELS, 0.01)


def run(batch):
    """Two estimates, with a memory behind their states."""
    memory = np.ones((*batch.states.shape[:2], 1))
    return [np.concatenate([share * batch.states, memory], axis=-1) for share in (0.9, 1.2)]


@pytest.mark.parametrize("at_once", [1, 3, 7])
def test_outcomes_of_blocks_are_those_of_all_episodes_at_once(at_once, monkeypatch):
    population = population_of(8)
    shown = tuple(population.episodes[i] for i in (6, 0, 5, 1))
    episodes = HeldOut(population, population.episodes, {}, shown, band_hz=(1.0, 9.0))
    whole = episodes.outcomes(run)
    monkeypatch.setattr(held_out, "SIDE_BY_SIDE", at_once)
    for found, wanted, share in zip(episodes.outcomes(run), whole, (0.9, 1.2), strict=True):
        assert set(found.errors) == set(population.episodes)
        for key, states in found.errors.items():
            for errors, expected in zip(states, wanted.errors[key], strict=True):
                assert errors == pytest.approx(expected, rel=1e-9, nan_ok=True)
            assert set(states[0]) == {"rms", "error_percent", "gearbox_band_power"}
            assert set(states[1]) - set(states[0]) == {"true_rms", "true_error_percent", "true_lag_s"}
        assert set(found.shown) == set(shown)
        for key, piece in found.shown.items():
            np.testing.assert_array_equal(piece, share * population.read(key)[:, :2])


def test_episodes_that_are_none_twice_or_not_there_are_refused():
    population = population_of(1)
    one, other = population.episodes[0], EpisodeKey("unit 9", "default", "0")
    for keys, message in (((), "no episodes were named; check the split"), ((other,), "unit 9")):
        with pytest.raises(DataError, match=message):
            HeldOut(population, keys, {}).outcomes(run)
    with pytest.raises(DataError, match=r"episode 0 of unit .* named more than once"):
        EpisodeBatch.read(population, [one, one])
