"""Bad input to the residual-shaped observer: every refusal says what is wrong."""

import numpy as np
import pytest

from kros.core import DataError, SynthesisError
from kros.lifting import Lifting
from kros.observer.residual import one_step_residual, residual_spectra
from kros.synthesis.residual_shaped.residual_h2 import ResidualProblem, residual_h2

A, C, NOISE, SCALE, DT = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[1.0, 0.0]]), np.array([1e-3]), np.ones(2), 1e-2


def noise(*shape):
    return np.random.default_rng(0).standard_normal(shape)


def tone(freq):
    spectra = residual_spectra(
        np.cos(2 * np.pi * freq * np.arange(2000))[:, None, None] * np.ones(2), [2000], ["a"], 1000
    )
    spectra[..., 0, 1] = spectra[..., 1, 0] = 0
    return spectra


def problem(spectra, A=A):
    return residual_h2(ResidualProblem(A, C, spectra, NOISE, SCALE, DT))


LATE, WHITE = Lifting(("x", "v"), ("x[-5]*v",)), np.broadcast_to(np.eye(2) + 0j, (1, 65, 2, 2))
LOST = np.where(np.arange(500)[:, None, None] == 3, np.nan, noise(500, 1, 2))
REFUSED = {
    "unit b has 40 samples, at least 64": (
        DataError,
        lambda: residual_spectra(noise(500, 2, 2), [500, 40], ["a", "b"]),
    ),
    "NaN or infinity": (DataError, lambda: residual_spectra(LOST, [500], ["a"])),
    "at least 7 samples": (
        DataError,
        lambda: one_step_residual(LATE, np.eye(3), np.ones((3, 1)), noise(6, 1, 2), noise(6, 1, 1)),
    ),
    "can be predicted": (SynthesisError, lambda: problem(tone(0.0))),
    "can be predicte.": (SynthesisError, lambda: problem(tone(0.1))),
    "zero or not finite": (SynthesisError, lambda: problem(np.zeros((1, 65, 2, 2), complex))),
    "not detectable": (SynthesisError, lambda: problem(WHITE, np.diag([0.5, 1.2]))),
}


@pytest.mark.parametrize("match", REFUSED)
def test_what_is_wrong_is_said(match):
    error, act = REFUSED[match]
    with pytest.raises(error, match=match):
        act()


def test_a_channel_without_residual_is_no_obstacle():
    spectra = np.zeros((1, 65, 2, 2), complex)
    spectra[..., 1, 1] = 1e-4
    found = residual_h2(ResidualProblem(A, C, spectra, NOISE, SCALE, DT))
    assert found.spectral_radius < 1
