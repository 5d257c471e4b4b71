"""Shaping filters of a worst case: on the asked side, as tight from below as from above."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from kros.core import StateSpace, block_diagonal, gain
from kros.synthesis import ObserverProblem
from kros.synthesis.worst_case.disturbance import Channels, Spectrum, design_grid
from kros.uncertainty import fit_magnitude

Array = npt.NDArray[Any]

DT = 1e-3
OPTIONS: dict[str, Any] = {"max_order": 3, "tolerance_db": 0.5}


def _channels() -> Channels:
    lag = StateSpace(np.array([[0.97]]), np.array([[1.0]]), np.array([[0.03]]), np.array([[0.001]]), DT)
    nominal = StateSpace(np.diag([0.95, 0.9]), np.eye(2), np.eye(2), np.zeros((2, 2)), DT)
    W_L, W_R = block_diagonal([lag, lag]), gain(0.1 * np.eye(2), DT)
    scales: dict[str, Any] = {"input_scale": np.ones(2), "output_scale": np.ones(2), "noise": np.array([1e-3])}
    problem = ObserverProblem(nominal=nominal, C=np.eye(2)[:1], W_L=W_L, W_R=W_R, n_original=2, **scales)
    return Channels(problem, design_grid(problem))


def _powers(channels: Channels, system: StateSpace) -> Array:
    return np.asarray(np.abs(np.diagonal(system.frequency_response(channels.freqs_hz), axis1=1, axis2=2)) ** 2)


@pytest.mark.parametrize("side", ["above", "below"])
def test_filters_touch_their_spectra_from_the_asked_side(side: str) -> None:
    channels = _channels()
    corner = channels.freqs_hz[:, None] / np.array([20.0, 3.0])
    phi = np.array([4.0, 1e-6]) / (1 + corner**2) + np.array([0.01, 2e-9])
    ratio = (
        _powers(channels, channels.shaping(Spectrum(phi, None), partial(fit_magnitude, **OPTIONS), side).filters) / phi
    )
    at, beyond = (ratio.min(axis=0), ratio.max(axis=0)) if side == "above" else (ratio.max(axis=0), ratio.min(axis=0))
    np.testing.assert_allclose(at, 1.0, rtol=1e-9)
    own = [fit_magnitude(channels.freqs_hz, np.sqrt(column), DT, **OPTIONS) for column in phi.T]
    np.testing.assert_allclose(np.abs(10 * np.log10(beyond)), [fit.overbound_db for fit in own], atol=0.05)
