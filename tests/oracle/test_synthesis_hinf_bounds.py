"""Lower bounds of H-infinity synthesis lie below every norm that a controller attains, and meet the optimum where the
plant is well posed."""

from dataclasses import replace

import numpy as np
import pytest

from kros.core import SynthesisError, hinf_norm
from kros.synthesis import GeneralizedPlant, Status, hinf

NOISES = (1e-7, 1e-5, 1e-4)


def small_noise(noise=1e-6, dt=0.0):
    """Two states, a cheap control and a nearly perfect measurement: fast and slow modes far apart in the Hamiltonian
    matrices."""
    A = np.array([[-0.5, -0.3], [1.1, 0.3]])
    A = A if dt == 0 else np.eye(2) + 0.3 * A
    C1, zero = [[1.1, -1.2], [0, 0]], np.zeros((2, 2))
    return GeneralizedPlant(
        A, [[0.9, 0], [0.1, 0]], [[0.3], [0.6]], C1, [[0.2, 0]], zero, [[0], [0.1]], [[0, noise]], [[0]], dt
    )


def drawn(rng, dt, noise, penalty):
    """A random plant with a small penalty and a small noise."""
    n = int(rng.integers(1, 5))
    A = rng.standard_normal((n, n))
    poles = np.linalg.eigvals(A)
    A = A * (0.9 / np.abs(poles).max()) if dt > 0 else A - (poles.real.max() + 0.1) * np.eye(n)
    B1, C1 = (
        np.hstack([rng.standard_normal((n, 1)), np.zeros((n, 1))]),
        np.vstack([rng.standard_normal((1, n)), np.zeros((1, n))]),
    )
    B2, C2 = rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    return GeneralizedPlant(A, B1, B2, C1, C2, np.zeros((2, 2)), [[0], [penalty]], [[0, noise]], [[0]], dt)


def attained_by_others(plant):
    """Smallest norm on the plant of controllers that were designed for noisier measurements and dearer controls, where
    rounding is no matter."""
    best = np.inf
    for factor in (1e2, 1e4):
        for penalty in (1.0, factor):
            try:
                K = hinf(replace(plant, D12=penalty * plant.D12, D21=factor * plant.D21), tolerance=1e-3).controller
            except SynthesisError:
                continue
            best = min(best, hinf_norm(plant.close(K)))
    return best


def test_a_small_noise_is_no_obstacle():
    found = hinf(small_noise())
    assert found.hinf_norm < 3.9
    assert found.lower_bound <= attained_by_others(small_noise()) * (1 + 1e-9)
    assert found.status is Status.OPTIMAL


@pytest.mark.parametrize("dt", [0.0, 1.0])
@pytest.mark.parametrize("noise", NOISES)
def test_no_bound_above_what_is_attained(noise, dt):
    rng = np.random.default_rng([8, int(dt), NOISES.index(noise)])
    for plant in (small_noise(noise, dt), drawn(rng, dt, noise, 1e-2)):
        found = hinf(plant)
        best = attained_by_others(plant)
        assert found.lower_bound <= min(best, found.hinf_norm) * (1 + 1e-9)
        assert found.hinf_norm <= best * (1 + 1e-3)


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_modes_without_effect_do_not_loosen_the_bound(dt):
    """States that disturbances, controls or outputs do not touch, twice the same pole, and units far apart."""
    pole = 0.9 if dt > 0 else -0.1
    A, zero = np.diag([pole, pole, 1.2 if dt > 0 else 0.2]), np.zeros((2, 2))
    B1, C1 = [[0, 0], [1.0, 0], [1.0, 0]], [[1.0, 0.5, 1.0], [0, 0, 0]]
    B2, C2 = np.array([[1.0], [0.5], [1.0]]), np.array([[0.0, 1.0, 1.0]])
    plant = GeneralizedPlant(A, B1, B2, C1, C2, zero, [[0], [0.1]], [[0, 0.1]], [[0]], dt)
    t = np.array([1e3, 1.0, 1e-3])
    other = replace(
        plant, A=A * t[:, None] / t, B1=plant.B1 * t[:, None], B2=B2 * t[:, None], C1=plant.C1 / t, C2=C2 / t
    )
    for p in (plant, other):
        assert hinf(p).status is Status.OPTIMAL
    assert hinf(other).lower_bound == pytest.approx(hinf(plant).lower_bound, rel=1e-5)  # where the search ends
