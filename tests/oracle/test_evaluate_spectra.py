"""Spectra of errors against the power of known signals; observers that share a model share a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kros.evaluate.errors import error_spectrum, summarise
from kros.evaluate.held_out import alike
from kros.lifting import Lifting
from kros.observer import Observer

DT = 1e-3


@pytest.mark.parametrize("axis", [0, 1, -1])
def test_power_of_a_sine_is_half_its_squared_amplitude(axis: int) -> None:
    times = DT * np.arange(5120)
    signals = np.stack([3 * np.sin(2 * np.pi * 125 * times), 0.5 * np.cos(2 * np.pi * 250 * times)])[..., None]
    freqs, density = error_spectrum(np.moveaxis(signals, 1, axis), DT, axis=axis)
    density = np.moveaxis(density, axis, -1).reshape(2, -1)
    np.testing.assert_allclose(density.sum(axis=1) * freqs[1], [4.5, 0.125], rtol=1e-6)
    np.testing.assert_array_equal(freqs[density.argmax(axis=1)], [125.0, 250.0])


def test_power_of_white_noise_is_its_variance() -> None:
    freqs, density = error_spectrum(np.random.default_rng(2).normal(size=(200_000, 1)), DT)
    assert density.sum() * freqs[1] == pytest.approx(1.0, rel=0.02)


def test_a_diverged_estimate_spoils_no_other_spectrum() -> None:
    truth, estimate = np.zeros((2000, 2, 1)), np.random.default_rng(3).normal(size=(2000, 2, 1))
    estimate[1000:, 0] = np.inf
    alone = summarise(estimate[None, :, 1:], truth[:, 1:], np.array([2000]), DT)[0]
    both = summarise(estimate[None], truth, np.array([2000, 2000]), DT)[0]
    assert not np.isfinite(both.spectra[0]).any()
    np.testing.assert_allclose(both.spectra[1:], alone.spectra, rtol=1e-12)


def test_observers_of_one_model_share_a_run() -> None:
    lifting = Lifting(("x", "v"))
    first = Observer.open_loop("a", lifting, np.eye(2), np.ones((2, 1)), (0,), ("u",), DT)
    names = [
        [o.name for o in g] for g in alike([first, replace(first, name="b", measured=(1,)), replace(first, name="c")])
    ]
    assert names == [["a", "c"], ["b"]]
    assert [len(g) for g in alike([first] * 20)] == [8, 8, 4]
