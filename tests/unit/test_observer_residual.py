"""Bad input to the residual-shaped observer: every refusal says what is wrong."""

import numpy as np
import pytest

from kros.core import DataError, DimensionError, SynthesisError
from kros.lifting import Lifting
from kros.observer.residual.one_step import one_step_residual, residual_spectra
from kros.synthesis import ResidualProblem, residual_h2
from kros.synthesis.residual_shaped.shaping_filter import Basis, shaping_filter

A, C, NOISE, SCALE, DT = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[1.0, 0.0]]), [1e-3], [1.0, 1.0], 1e-2


def noise(*shape):
    return np.random.default_rng(0).standard_normal(shape)


def test_short_episodes_name_the_unit():
    with pytest.raises(DataError, match="unit b has 40 samples, at least 64"):
        residual_spectra(noise(500, 2, 2), [500, 40], ["a", "b"])


def test_recordings_that_are_not_finite():
    residual = noise(500, 1, 2)
    residual[3] = np.nan
    with pytest.raises(DataError, match="NaN or infinity"):
        residual_spectra(residual, [500], ["a"])


def test_one_length_and_unit_an_episode():
    with pytest.raises(DimensionError, match="as many lengths"):
        residual_spectra(noise(500, 2, 2), [500], ["a", "b"])


def test_states_and_inputs_of_one_length():
    with pytest.raises(DimensionError, match="agree in"):
        one_step_residual(Lifting(("x", "v")), A, np.ones((2, 1)), noise(20, 1, 2), noise(19, 1, 1))


def test_episodes_shorter_than_the_delays():
    lifting = Lifting(("x", "v"), ("x[-5]*v",))
    with pytest.raises(DataError, match="at least 7 samples"):
        one_step_residual(lifting, np.eye(3), np.ones((3, 1)), noise(6, 1, 2), noise(6, 1, 1))


@pytest.mark.parametrize("tone", [0.0, 0.1], ids=["constant", "one tone"])
def test_residual_that_can_be_predicted(tone):
    residual = np.cos(2 * np.pi * tone * np.arange(2000))[:, None, None] * np.ones(2)
    spectra = residual_spectra(residual, [2000], ["a"], segment=1000)
    spectra[..., 0, 1] = spectra[..., 1, 0] = 0
    with pytest.raises(SynthesisError, match="can be predicted"):
        residual_h2(ResidualProblem(A, C, spectra, NOISE, SCALE, DT))


def test_no_residual():
    with pytest.raises(SynthesisError, match="zero or not finite"):
        residual_h2(ResidualProblem(A, C, np.zeros((1, 65, 2, 2), complex), NOISE, SCALE, DT))


def test_a_channel_without_residual_is_no_obstacle():
    spectra = np.zeros((1, 65, 2, 2), complex)
    spectra[..., 1, 1] = 1e-4
    found = residual_h2(ResidualProblem(A, C, spectra, NOISE, SCALE, DT))
    assert found.spectral_radius < 1


def test_shapes_are_named():
    with pytest.raises(DimensionError, match=r"spectra \(unit, f, n, n\)"):
        residual_h2(ResidualProblem(A, C, np.ones((65, 2, 2), complex), NOISE, SCALE, DT))
    with pytest.raises(DimensionError, match=r"\(f, n, n\)"):
        shaping_filter(np.ones((65, 2, 3), complex), Basis(), DT)


@pytest.mark.parametrize("options", [{"delays": -1}, {"poles": (1.0,)}, {"poles": (0.5, 0.5)}, {"poles": (0.0,)}])
def test_banks_that_make_no_sense(options):
    with pytest.raises(DimensionError, match="different poles inside the unit circle"):
        Basis(**options)


def test_unobservable_plants_are_refused():
    with pytest.raises(SynthesisError, match="not detectable"):
        residual_h2(
            ResidualProblem(np.diag([0.5, 1.2]), C, np.broadcast_to(np.eye(2) + 0j, (1, 65, 2, 2)), NOISE, SCALE, DT)
        )
