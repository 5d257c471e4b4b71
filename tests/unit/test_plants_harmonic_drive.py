"""Settings, shapes, seeds and forms of the simulated motor drives."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from kros.core.errors import ConfigError
from kros.data import EpisodeKey
from kros.plants import HarmonicDrivePopulation
from kros.plants.harmonic_drive.dynamics import NOMINAL, OUTLIER_LOG_FACTORS, RIPPLE_DEVIATION, DriveParameters

SMALL = HarmonicDrivePopulation(n_units=3, n_episodes=2, seconds=3.0, seed=4, outlier=True)
LOADED = EpisodeKey("001002", "load", "1")


@pytest.fixture(scope="module")
def small():
    return SMALL.simulate()


def test_a_unit_is_the_same_whatever_else_is_simulated(small):
    alone = HarmonicDrivePopulation(n_units=2, n_episodes=3, seconds=3.0, seed=4, conditions=("load",)).simulate()
    np.testing.assert_allclose(alone.population.read(LOADED), small.population.read(LOADED), atol=1e-9)
    for field in fields(alone.truth.parameters):
        np.testing.assert_array_equal(
            getattr(alone.truth.parameters, field.name), getattr(small.truth.parameters, field.name)[1:3]
        )


@pytest.mark.parametrize("spread", [0.5, 1.0, 2.0])
def test_spread_scales_the_stated_relative_deviations(spread):
    p = DriveParameters(**HarmonicDrivePopulation(n_units=3000, seed=1, spread=spread).units()[1])
    for name, (nominal, deviation) in NOMINAL.items():
        logs = np.log(getattr(p, name) / nominal)
        assert abs(logs.mean()) < 5 * spread * deviation / np.sqrt(3000)
        assert logs.std() == pytest.approx(spread * deviation, rel=0.08)
        assert 0.05 <= deviation <= 0.15
    assert np.log(p.ripple).std(axis=0) == pytest.approx(spread * RIPPLE_DEVIATION, rel=0.08)
    assert np.all((p.phase_rad >= 0) & (p.phase_rad < 2 * np.pi))
    assert np.all(np.abs(np.exp(1j * p.phase_rad).mean(axis=0)) < 0.08)


def test_outlier_is_loose_by_its_severity():
    mild, loose = (DriveParameters(**replace(SMALL, outlier_severity=s).units()[1]).take([0]) for s in (0.0, 1.5))
    for name, log_factor in OUTLIER_LOG_FACTORS.items():
        np.testing.assert_allclose(getattr(loose, name), np.exp(1.5 * log_factor) * getattr(mild, name))
    np.testing.assert_array_equal(loose.motor_inertia, mild.motor_inertia)
    assert "000000" not in replace(SMALL, outlier=False).simulate().population.unit_ids


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
