"""Magnitude fits against data whose exact answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError, DimensionError
from kros.uncertainty import fit_magnitude
from kros.uncertainty.weights.proof import invert

DT = 1e-3
FREQS = np.geomspace(500e-6, 500.0, 1000)
W = 1j * np.tan(np.pi * FREQS[:-1] * DT)  # the bilinear variable on the unit circle, without Nyquist


def magnitude_of(zeros: list[complex], poles: list[complex]) -> np.ndarray:
    """Exact discrete magnitude with given zeros and poles in w, Nyquist included (where it is one)."""
    values = np.abs(np.prod([W - q for q in zeros], axis=0) / np.prod([W - p for p in poles], axis=0))
    return np.append(values, 1.0)


def measured(fit, freqs: np.ndarray = FREQS) -> np.ndarray:
    return np.abs(fit.system.frequency_response(freqs)[:, 0, 0])


MIDDLE = np.pi * 0.5 * DT  # w at 0.5 Hz, the middle of the band on a log scale


@pytest.mark.parametrize(
    ("zeros", "poles"),
    [
        ([-MIDDLE], [-0.1 * MIDDLE]),
        ([-MIDDLE], [-10 * MIDDLE]),
        ([-MIDDLE, -MIDDLE], [-0.1 * MIDDLE, -10 * MIDDLE]),
        ([-1.0], [-1e-5]),
        ([-1e-5], [-0.3]),
        ([-3e-4 + 2e-3j, -3e-4 - 2e-3j, -0.2], [-1e-4 + 3e-3j, -1e-4 - 3e-3j, -2e-5]),
    ],
)
def test_exactly_representable_data_are_recovered(zeros: list[complex], poles: list[complex]) -> None:
    data = magnitude_of(zeros, poles)
    fit = fit_magnitude(FREQS, data, DT, max_order=len(poles), tolerance_db=0.0)
    ratio_db = 20 * np.log10(measured(fit) / data)
    assert np.abs(ratio_db).max() < 0.01
    assert (ratio_db >= -1e-9).all()


def test_three_resonances_at_order_six() -> None:
    """A ripple of half a dB on three light resonances can be bounded within twice that, and not much better."""
    pairs = [(np.tan(np.pi * f0 * DT), z) for f0, z in ((1.0, 0.02), (20.0, 0.01), (120.0, 0.03))]
    poles = [c for a, z in pairs for c in (a * (-z + 1j * np.sqrt(1 - z * z)), a * (-z - 1j * np.sqrt(1 - z * z)))]
    zeros = [c for a, _ in pairs for c in (a * (-0.6 + 0.8j), a * (-0.6 - 0.8j))]
    data = magnitude_of(zeros, poles)
    assert fit_magnitude(FREQS, data, DT, max_order=6, tolerance_db=0.0).overbound_db < 0.01
    rippled = data * 10 ** (0.25 / 20 * np.sin(9 * np.log(FREQS)))
    fit = fit_magnitude(FREQS, rippled, DT, max_order=6, tolerance_db=0.0)
    assert fit.overbound_db < 0.55
    assert (measured(fit) >= rippled * (1 - 1e-9)).all()


@pytest.mark.parametrize("seed", range(4))
def test_bounds_random_smooth_data_as_used(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bends = np.cumsum(rng.normal(size=8))
    data = np.exp(np.interp(np.log(FREQS), np.linspace(np.log(FREQS[0]), np.log(FREQS[-1]), 8), bends))
    fit = fit_magnitude(FREQS, data, DT, tolerance_db=0.5)
    ratio = measured(fit) / data
    assert ratio.min() >= 1 - 1e-9
    assert 20 * np.log10(ratio.max()) == pytest.approx(fit.overbound_db, abs=1e-6)
    assert fit.system.is_stable()
    assert invert(fit.system).is_stable()
    assert fit.order <= 4
    assert np.isfinite(fit.system.A).all()


def test_smallest_order_within_the_tolerance_is_taken() -> None:
    data = magnitude_of([-MIDDLE], [-10 * MIDDLE])
    assert fit_magnitude(FREQS, data, DT).order == 1
    assert fit_magnitude(FREQS, np.full(1000, 3.0), DT).order == 0
    assert fit_magnitude(FREQS, data, DT, tolerance_db=25.0).order == 0


def test_grid_with_dc_and_nyquist() -> None:
    freqs = np.concatenate([[0.0], FREQS])
    data = np.concatenate([[20.0], magnitude_of([-1e-3], [-5e-5])])
    fit = fit_magnitude(freqs, data, DT, max_order=1, tolerance_db=0.0)
    np.testing.assert_allclose(measured(fit, freqs), data, rtol=1e-3)


def test_poles_next_to_one_keep_their_precision() -> None:
    """A pole 1e-6 from the unit circle, against the response in the bilinear variable."""
    fit = fit_magnitude(FREQS, magnitude_of([-1e-2], [-5e-7]), DT, max_order=1, tolerance_db=0.0)
    pole = fit.system.poles()[0]
    assert 1 - pole.real == pytest.approx(1e-6, rel=1e-4)


def test_zero_and_bad_magnitudes() -> None:
    zero = fit_magnitude(FREQS, np.zeros(1000), DT)
    assert zero.order == 0
    assert not zero.system.D.any()
    with pytest.raises(DataError, match="not negative"):
        fit_magnitude(FREQS, np.full(1000, -1.0), DT)
    with pytest.raises(DimensionError, match="1000"):
        fit_magnitude(FREQS, np.ones(3), DT)
    with pytest.raises(ConfigError, match="Nyquist"):
        fit_magnitude(2 * FREQS, np.ones(1000), DT)
    with pytest.raises(ConfigError, match="negative"):
        fit_magnitude(FREQS, np.ones(1000), DT, max_order=-1)
