"""Errors of estimates against sums written out by hand, and spectra against the definition of a periodogram."""

import numpy as np
import pytest

from kros.evaluate.errors import error_percent, error_rms, error_spectrum, errors_of

DT = 0.01


def episodes(lengths, seed=0):
    """Truth and estimate, shape (n_samples, batch, 2); what is behind an episode's end is wild and must not count."""
    rng = np.random.default_rng(seed)
    shape = (max(lengths), len(lengths), 2)
    truth, estimate = 1e-3 * (rng.normal(size=shape) - 0.7), 1e-3 * rng.normal(size=shape)
    for b, length in enumerate(lengths):
        truth[length:, b], estimate[length:, b] = 1e6, -1e6
    return truth, estimate


def by_hand(truth, estimate, lengths):
    """RMS and percent of the largest absolute value, one number after the other."""
    rms, percent = np.empty((2, len(lengths), 2))
    for b, length in enumerate(lengths):
        for channel in range(2):
            squares = [(estimate[k, b, channel] - truth[k, b, channel]) ** 2 for k in range(length)]
            rms[b, channel] = (sum(squares) / length) ** 0.5
            percent[b, channel] = 100 * rms[b, channel] / max(abs(truth[k, b, channel]) for k in range(length))
    return rms, percent


@pytest.mark.parametrize("lengths", [(700, 700, 700), (700, 41, 600), (513,), (600, 600, 600, 600, 600, 600, 600, 550)])
def test_errors_are_those_of_the_definition(lengths):
    truth, estimate = episodes(lengths)
    rms, percent = by_hand(truth, estimate, lengths)
    counts = np.array(lengths)
    found = errors_of(estimate, truth, counts, DT)
    for values in (found["rms"], error_rms(estimate, truth, counts)):
        np.testing.assert_allclose(values, rms, rtol=1e-12)
    for values in (found["error_percent"], error_percent(estimate, truth, counts)):
        np.testing.assert_allclose(values, percent, rtol=1e-12)


@pytest.mark.parametrize("lengths", [(700, 700), (700, 600)])
def test_a_largest_value_may_be_negative(lengths):
    """Minus four is the largest absolute value although every sample is below zero."""
    truth = np.full((700, 2, 1), -1.0)
    truth[5] = -4.0
    percent = error_percent(truth + 2.0, truth, np.array(lengths))
    np.testing.assert_allclose(percent, 50.0, rtol=1e-12)


@pytest.mark.parametrize("lengths", [(10, 10), (10, 6)])
def test_a_state_at_zero_has_no_percentage(lengths):
    truth = np.zeros((10, 2, 1))
    percent = error_percent(truth + 1.0, truth, np.array(lengths))
    assert np.isnan(percent).all()


def test_diverged_estimates_are_not_finite_and_nobody_is_warned():
    truth, estimate = episodes((600, 600))
    estimate[100:, 0, 0] = 1e300
    found = errors_of(estimate, truth, np.array([600, 600]), DT, (0.0, 1.0))
    for values in found.values():
        assert not np.isfinite(values[0, 0])
        assert np.isfinite(values[1]).all()


def periodogram(x):
    """One-sided power spectral density by Welch's method, from its definition: Hann windows of 512 samples, half overlapping, means removed."""
    window = np.array([0.5 - 0.5 * np.cos(2 * np.pi * k / 512) for k in range(512)])
    k = np.arange(512)
    frequencies = np.arange(257)
    transform = np.exp(-2j * np.pi * np.outer(frequencies, k) / 512)
    pieces = [x[start : start + 512] for start in range(0, len(x) - 511, 256)]
    powers = [np.abs(transform @ (window * (piece - piece.mean()))) ** 2 for piece in pieces]
    density = np.mean(powers, axis=0) * DT / np.sum(window**2)
    density[1:-1] *= 2
    return frequencies / (512 * DT), density


def test_powers_are_those_of_the_definition_both_ends_of_the_band_included():
    lengths = (1100, 1100, 900, 1100, 1100, 1100, 1100, 1100, 1100)  # more episodes of one length than are done at once
    truth, estimate = episodes(lengths, seed=3)
    band = tuple(np.fft.rfftfreq(512, DT)[[10, 20]])
    found = errors_of(estimate, truth, np.array(lengths), DT, band)["gearbox_band_power"]
    for b, length in enumerate(lengths):
        for channel in range(2):
            error = (estimate - truth)[:length, b, channel]
            freqs, density = periodogram(error)
            for actual, expected in zip(error_spectrum(error, DT), (freqs, density), strict=True):
                np.testing.assert_allclose(actual, expected, rtol=1e-9)
            assert found[b, channel] == pytest.approx(density[10:21].sum() / (512 * DT), rel=1e-9)


def test_short_signals_are_padded_to_the_same_frequencies():
    freqs, density = error_spectrum(np.random.default_rng(0).normal(size=(100, 3)), DT)
    assert freqs.shape == (257,)
    assert density.shape == (257, 3)


def test_a_diverged_estimate_spoils_no_other_spectrum():
    truth, estimate = np.zeros((2000, 2, 1)), np.random.default_rng(3).normal(size=(2000, 2, 1))
    estimate[1000:, 0] = np.inf
    band = 10.0, 100.0
    alone = errors_of(estimate[:, 1:], truth[:, 1:], np.array([2000]), DT, band)["gearbox_band_power"]
    both = errors_of(estimate, truth, np.array([2000, 2000]), DT, band)["gearbox_band_power"]
    assert not np.isfinite(both[0]).any()
    np.testing.assert_allclose(both[1:], alone, rtol=1e-12)
