"""Settings, shapes, seeds and forms of the simulated motor drives."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError
from kros.data import EpisodeKey, write_raw
from kros.data.readers.motor_drive_raw import read_motor_drive_raw
from kros.plants import HarmonicDrivePopulation
from kros.plants.harmonic_drive.parameters import NOMINAL, OUTLIER_LOG_FACTORS, RIPPLE_DEVIATION, draw_outlier, draw_parameters
from kros.plants.harmonic_drive.reference import (
    ACCELERATION_SAMPLES,
    JERK_SAMPLES,
    MAX_SPEED,
    REVOLUTION,
    episode_reference,
    profile,
)

SMALL = HarmonicDrivePopulation(n_units=3, n_episodes=2, seconds=3.0, seed=4, outlier=True)
LOADED = EpisodeKey("001002", "load", "1")


@pytest.fixture(scope="module")
def small():
    return SMALL.simulate()


def test_population_has_the_form_of_the_reader(small):
    population = small.population
    assert population.unit_ids == ("000000", "001001", "001002", "001003")
    assert [u.group for u in population.units] == ["outliers", "population", "population", "population"]
    assert population.conditions == ("load", "noload")
    assert population.states == ("position", "velocity", "current")
    assert population.inputs == ("target_position", "target_velocity")
    assert population.measured == ("position",)
    assert len(population.episodes) == 16
    assert population.sample_period_s == 1e-3
    assert dict(population.metadata) == {"plant": "harmonic-drive", "gear_ratio": 100}
    for key in population.episodes:
        assert population.read(key).shape == (3000, 5)
        assert small.raw.read(key).shape == (4001, 5)


def test_writing_and_reading_the_raw_layout_gives_the_population(small, tmp_path):
    write_raw(small.raw, tmp_path / "raw")
    read = read_motor_drive_raw(tmp_path / "raw")
    assert read.episodes == small.population.episodes
    assert read.units == small.population.units
    for key in read.episodes:
        # Rounding of the files: 1e-6 deg and 1e-5 deg/s on the motor side, 1e-4 percent.
        assert np.all(np.abs(read.read(key) - small.population.read(key)).max(axis=0) < [1e-9, 1e-8, 1e-6, 1e-9, 1e-8])


def test_rest_is_at_rest_and_calibrates_the_offset(small):
    for key in small.population.episodes:
        raw, prepared = small.raw.read(key), small.population.read(key)
        assert np.ptp(raw[:1000, 3]) == 0
        assert not np.any(raw[:1000, 4])
        assert np.ptp(raw[:1000, 0]) < 1e-5
        offset = np.mean(raw[:1000, 0] - raw[:1000, 3])
        np.testing.assert_allclose(raw[1000:-1, 0] - prepared[:, 0], offset, atol=2e-6)
        assert abs(prepared[0, 0] - prepared[0, 3]) < 1e-5
        assert abs(offset) < 0.021
    offsets = {round(float(small.raw.read(k)[0, 0] - small.raw.read(k)[0, 3]), 6) for k in small.raw.episodes}
    assert len(offsets) == len(small.raw.episodes)


def test_a_unit_is_the_same_whatever_else_is_simulated(small):
    alone = HarmonicDrivePopulation(n_units=2, n_episodes=3, seconds=3.0, seed=4, conditions=("load",)).simulate()
    np.testing.assert_allclose(alone.population.read(LOADED), small.population.read(LOADED), atol=1e-9)
    for field in fields(alone.truth.parameters):
        np.testing.assert_array_equal(getattr(alone.truth.parameters, field.name), getattr(small.truth.parameters, field.name)[1:3])


def test_the_seed_decides(small):
    again = SMALL.simulate()
    other = replace(SMALL, seed=5).simulate()
    for key in small.population.episodes:
        np.testing.assert_array_equal(again.population.read(key), small.population.read(key))
    assert np.abs(other.population.read(LOADED) - small.population.read(LOADED))[:, 3].max() > 0.1
    assert not np.allclose(other.truth.phase_rad, small.truth.phase_rad)


@pytest.mark.parametrize("spread", [0.5, 1.0, 2.0])
def test_spread_scales_the_stated_relative_deviations(spread):
    p = draw_parameters(1, 3000, spread)
    for name, (nominal, deviation) in NOMINAL.items():
        logs = np.log(getattr(p, name) / nominal)
        assert abs(logs.mean()) < 5 * spread * deviation / np.sqrt(3000)
        assert logs.std() == pytest.approx(spread * deviation, rel=0.08)
        assert 0.05 <= deviation <= 0.15
    assert np.log(p.ripple).std(axis=0) == pytest.approx(spread * RIPPLE_DEVIATION, rel=0.08)
    assert np.all((p.phase_rad >= 0) & (p.phase_rad < 2 * np.pi))
    assert np.all(np.abs(np.exp(1j * p.phase_rad).mean(axis=0)) < 0.08)


def test_outlier_is_loose_by_its_severity():
    mild, loose = draw_outlier(2, 1.0, 0.0), draw_outlier(2, 1.0, 1.5)
    for name, log_factor in OUTLIER_LOG_FACTORS.items():
        np.testing.assert_allclose(getattr(loose, name), np.exp(1.5 * log_factor) * getattr(mild, name))
    np.testing.assert_array_equal(loose.motor_inertia, mild.motor_inertia)
    assert "000000" not in replace(SMALL, outlier=False).simulate().population.unit_ids


def test_truth_is_plain_json_and_complete(small):
    truth = json.loads(json.dumps(small.truth.as_dict()))
    assert truth["loop"] == "stiff"
    assert set(truth["units"]) == set(small.population.unit_ids)
    unit = truth["units"]["001002"]
    assert set(NOMINAL) <= set(unit)
    assert unit["phase_rad"][0] == small.truth.phase_rad[2]
    assert unit["lag_rad"] == pytest.approx(small.truth.lag_rad[2])


def test_load_torque_belongs_to_loaded_episodes(small):
    assert small.truth.load_torque(LOADED).shape == (3000,)
    with pytest.raises(DataError, match="noload"):
        small.truth.load_torque(replace(LOADED, condition="noload"))


@pytest.mark.parametrize(
    "settings",
    [
        {"n_units": 0},
        {"n_episodes": 0},
        {"seconds": 1.0},
        {"seconds": float("nan")},
        {"spread": -0.1},
        {"spread": 9.0},
        {"outlier_severity": 3.0},
        {"seed": -1},
        {"loop": "floppy"},
        {"conditions": ()},
        {"conditions": ("noload", "noload")},
        {"conditions": ("warm",)},
    ],
)
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ConfigError, match=next(iter(settings))):
        HarmonicDrivePopulation(**settings)


@pytest.mark.parametrize("seconds", [2.0, 3.3, 20.0, 100.0])
@pytest.mark.parametrize("episode", [0, 1, 7])
def test_reference_uses_full_speed_in_both_directions(seconds, episode):
    n = round(seconds * 1000)
    position, velocity = episode_reference(11, episode, n, 1000, 1e-3)
    assert len(position) == len(velocity) == n + 1000
    assert np.abs(position).max() <= REVOLUTION + 1e-9
    assert np.abs(velocity).max() <= MAX_SPEED * (1 + 1e-8)
    assert np.count_nonzero(velocity > 0.9999 * MAX_SPEED) > 300
    assert np.count_nonzero(velocity < -0.9999 * MAX_SPEED) > 300
    assert np.all(position[:1000] == position[0])
    assert not np.any(velocity[:1000])
    assert abs(velocity[-1]) < 0.01
    np.testing.assert_allclose(velocity[1:-1], (position[2:] - position[:-2]) / 2e-3, atol=1e-7)


def test_profile_is_a_smoothed_trapezoid():
    position, velocity = profile(np.array([0.5, 2.5]), np.array([100.0]), 1500, 1e-3)
    assert position[0] == 0.5
    assert position[-1] == pytest.approx(2.5, abs=1e-12)
    acceleration, jerk = np.diff(velocity) / 1e-3, np.diff(velocity, 2) / 1e-6
    peak = MAX_SPEED / (ACCELERATION_SAMPLES * 1e-3)
    assert np.abs(acceleration).max() == pytest.approx(peak, rel=1e-6)
    assert np.abs(jerk).max() == pytest.approx(peak / (JERK_SAMPLES * 1e-3), rel=1e-3)
    np.testing.assert_allclose(np.sum(velocity) * 1e-3, 2.0, rtol=1e-9)
    middle = 100 + (2.0 / (MAX_SPEED * 1e-3) + ACCELERATION_SAMPLES + JERK_SAMPLES) / 2  # by symmetry, half-way there
    assert np.interp(middle, np.arange(1500.0), position) == pytest.approx(1.5, abs=MAX_SPEED * 2e-3)
