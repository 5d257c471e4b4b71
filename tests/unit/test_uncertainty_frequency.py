"""Frequency grids, the nominal's choice, and the spectral factor."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.errors import ConfigError
from kros.core.frequency import check_grid, log_grid, nyquist_hz
from kros.uncertainty.weights.magnitude import RationalMagnitude
from kros.uncertainty.weights.sections import bilinear_squared

DT = 1e-3


def test_default_grid_spans_six_decades_up_to_nyquist() -> None:
    grid = log_grid(DT)
    assert len(grid) == 1000
    assert grid[-1] == 500.0 == nyquist_hz(DT)
    assert grid[0] == pytest.approx(500e-6)
    np.testing.assert_allclose(np.diff(np.log(grid)), np.log(10) * 6 / 999)


def test_bilinear_variable_keeps_relative_precision_near_dc() -> None:
    assert bilinear_squared(1e-9, DT) == pytest.approx((np.pi * 1e-12) ** 2, rel=1e-14)
    assert bilinear_squared([0.0, 250.0, 500.0], DT).tolist() == [0.0, pytest.approx(1.0), np.inf]


@pytest.mark.parametrize("bad", [[2.0, 1.0], [-1.0, 1.0], [1.0, 501.0], [np.nan], [], [[1.0]]])
def test_bad_grids_are_refused(bad: list[float]) -> None:
    with pytest.raises(ConfigError, match="grid"):
        check_grid(bad, DT)
    with pytest.raises(ConfigError):
        nyquist_hz(0.0)


@pytest.mark.parametrize("seed", range(6))
def test_spectral_factor_has_the_magnitude(seed: int) -> None:
    """Complex and real roots, in all pairings, against the rational function itself."""
    rng = np.random.default_rng(seed)
    knots = np.sort(10.0 ** rng.uniform(-8, 0, 4))

    def positive() -> np.ndarray:
        w = [complex(-(10 ** rng.uniform(-4, 0)), 0) for _ in range(2 * (seed % 3))]
        while len(w) < 4:
            p = 10 ** rng.uniform(-4, 0) * np.exp(1j * rng.uniform(np.pi / 2 + 0.1, np.pi))
            w += [p, np.conj(p)]
        powers = np.poly([-(x**2) for x in w]).real[::-1]
        return np.array([powers[k] / np.prod(knots[k:]) for k in range(5)])

    magnitude = RationalMagnitude(positive(), positive(), knots)
    (system,) = magnitude.factor().systems(DT)
    freqs = log_grid(DT, 60)
    np.testing.assert_allclose(
        np.abs(system.frequency_response(freqs)[:, 0, 0]) ** 2, magnitude(bilinear_squared(freqs, DT)), rtol=1e-6
    )
    assert system.is_stable()
