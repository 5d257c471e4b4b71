"""Frequency grids, the nominal's choice, and the spectral factor."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.errors import ConfigError, KrosError
from kros.core.frequency import bilinear_squared, check_grid, dense_grid, log_grid, nyquist_hz
from kros.uncertainty import Form
from kros.uncertainty.fits.spectral import RationalMagnitude, basis, roots, spectral_factor
from kros.uncertainty.nominal.choice import choose_nominals

DT = 1e-3


def test_default_grid_spans_six_decades_up_to_nyquist() -> None:
    grid = log_grid(DT)
    assert len(grid) == 1000
    assert grid[-1] == 500.0 == nyquist_hz(DT)
    assert grid[0] == pytest.approx(500e-6)
    np.testing.assert_allclose(np.diff(np.log(grid)), np.log(10) * 6 / 999)


def test_dense_grid_keeps_the_grid_and_adds_the_ends() -> None:
    grid = np.geomspace(1.0, 400.0, 11)
    dense = dense_grid(grid, DT, 10)
    assert np.isin(grid, dense).all()
    assert (dense[0], dense[-1]) == (0.0, 500.0)
    assert len(dense) >= 101
    assert (np.diff(dense) > 0).all()


def test_bilinear_variable_keeps_relative_precision_near_dc() -> None:
    assert bilinear_squared(1e-9, DT) == pytest.approx((np.pi * 1e-12) ** 2, rel=1e-14)
    assert bilinear_squared([0.0, 250.0, 500.0], DT).tolist() == [0.0, pytest.approx(1.0), np.inf]


@pytest.mark.parametrize("bad", [[2.0, 1.0], [-1.0, 1.0], [1.0, 501.0], [np.nan], [], [[1.0]]])
def test_bad_grids_are_refused(bad: list[float]) -> None:
    with pytest.raises(ConfigError, match="grid"):
        check_grid(bad, DT)
    with pytest.raises(ConfigError):
        nyquist_hz(0.0)
    with pytest.raises(ConfigError):
        log_grid(DT, 1)


def test_nominal_is_the_middle_of_a_line_of_plants() -> None:
    G = np.array([1.0, 1.2, 1.5, 2.4])[:, None, None, None] * np.ones((1, 3, 1, 1))
    choices = choose_nominals(G)
    assert choices[Form.ADDITIVE].index == 2
    assert choices[Form.ADDITIVE].peak_db == pytest.approx(20 * np.log10(0.9))
    assert choices[Form.INPUT_MULTIPLICATIVE].index == 3  # |1 / 2.4 - 1| is smaller than |2.4 / 1.5 - 1|


def test_roots_over_many_decades() -> None:
    knots = np.array([1e-9, 1e-4, 10.0])
    expected = np.array([-1e-11, -1e-5, -3.0])
    powers = np.poly(expected)[::-1]
    coefficients = [powers[k] / np.prod(knots[k:]) for k in range(4)]
    found, lead = roots(np.array(coefficients), knots)
    np.testing.assert_allclose(np.sort(np.real(found)), np.sort(expected), rtol=1e-9)
    assert lead == 1.0


def test_basis_is_a_power_over_the_common_denominator() -> None:
    knots, tau = np.array([0.1, 2.0]), np.array([0.0, 0.3, 5.0, np.inf])
    found, finite = basis(tau, knots), tau[:3]
    expected = np.array([np.full(3, 0.2), 2.0 * finite, finite**2]) / ((finite + 0.1) * (finite + 2.0))
    np.testing.assert_allclose(found[:3], expected.T)
    np.testing.assert_array_equal(found[3], [0.0, 0.0, 1.0])


def test_magnitudes_that_touch_zero_have_no_factor() -> None:
    knots = np.array([1.0])
    with pytest.raises(KrosError, match="positive"):
        spectral_factor(RationalMagnitude(np.array([1.0, -1.0]), np.array([1.0, 1.0]), knots), DT)


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
    system = spectral_factor(magnitude, DT)
    freqs = log_grid(DT, 60)
    np.testing.assert_allclose(np.abs(system.frequency_response(freqs)[:, 0, 0]) ** 2, magnitude(bilinear_squared(freqs, DT)), rtol=1e-6)
    assert system.is_stable()
