"""Spectra of errors against SciPy's Welch estimate and against Parseval's theorem; observers that share a model share a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import welch

from kros.evaluate.errors import error_spectrum, summarise
from kros.lifting import Lifting
from kros.observer import Observer
from kros.study.stages.evaluate import alike

DT = 1e-3


@pytest.mark.parametrize(
    ("shape", "axis", "segment"),
    [
        ((3000, 4, 2), 0, 512),
        ((4, 2, 3000), -1, 512),
        ((2, 1500, 3), 1, 512),
        ((300, 2), 0, 512),
        ((700,), 0, 512),
        ((513, 2), 0, 511),
        ((2, 2), 0, 512),
        ((5, 1), 0, 3),
        ((40, 50_000), 1, 512),
    ],
)
def test_spectra_are_those_of_scipy(shape: tuple[int, ...], axis: int, segment: int) -> None:
    error = 3 + np.random.default_rng(1).normal(size=shape)
    freqs, density = error_spectrum(error, DT, segment, axis)
    expected_freqs, expected = welch(error, fs=1 / DT, nperseg=min(segment, shape[axis]), nfft=segment, axis=axis)
    np.testing.assert_allclose(freqs, expected_freqs, rtol=1e-12)
    np.testing.assert_allclose(density, expected, rtol=1e-12, atol=1e-12 * expected.max())


def test_power_of_white_noise_is_its_variance() -> None:
    freqs, density = error_spectrum(np.random.default_rng(2).normal(size=(200_000, 1)), DT)
    assert density.sum() * freqs[1] == pytest.approx(1.0, rel=0.02)


def test_a_diverged_estimate_spoils_no_other_spectrum() -> None:
    truth, estimate = np.zeros((2000, 2, 1)), np.random.default_rng(3).normal(size=(2000, 2, 1))
    estimate[1000:, 0] = np.inf
    alone = summarise(estimate[:, 1:], truth[:, 1:], np.array([2000]), DT)
    both = summarise(estimate, truth, np.array([2000, 2000]), DT)
    assert not np.isfinite(both.spectra[0]).any()
    np.testing.assert_allclose(both.spectra[1:], alone.spectra, rtol=1e-12)


def test_observers_of_one_model_share_a_run() -> None:
    lifting = Lifting(("x", "v"))
    first = Observer.open_loop("a", lifting, np.eye(2), np.ones((2, 1)), (0,), ("u",), DT)
    names = [[o.name for o in g] for g in alike([first, replace(first, name="b", measured=(1,)), replace(first, name="c")])]
    assert names == [["a", "c"], ["b"]]
    assert [len(g) for g in alike([first] * 20)] == [8, 8, 4]
