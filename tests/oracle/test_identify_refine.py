"""Refinement against systems whose matrices are known, and sensitivities against finite differences of an independent
free run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from random_models import for_refinement
from scipy.linalg import expm

from kros import from_arrays
from kros.core import IdentificationError
from kros.data import Channel, EpisodeKey, Population, Role
from kros.identify import Factor, KoopmanMatrices, free_run, identify, unit_factors
from kros.identify.refine import RefineOptions, refine_population
from kros.identify.refine.metric import ResponsePrior, peak_residual
from kros.identify.refine.problem import stability_barrier
from kros.lifting import Lifting

KOOPMAN = Lifting(("x", "v"), ("sin(3*x + phase)",), ("phase",))
LINEAR = Lifting(("x", "v"))
A = np.array([[0.98, 0.10, 0.02], [-0.15, 0.90, 0.05]])
B = np.array([[0.01], [0.2]])
OPTIONS = RefineOptions(horizons=(5, 20, 80), segments=10, strengths=(1e2, 1.0, 1e-2))


def simulated(lifting: Lifting, n_units: int, noise: float, seed: int, spread: float = 0.02) -> tuple:
    """Population, keys, parameters, factors and the true rows of the states (unit, 2, n_lifted + 1)."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, n_units)
    W = np.concatenate([A[:, : lifting.n_lifted], B], axis=1) * (
        1 + spread * rng.standard_normal((n_units, 1, 1)) * [[[0], [1]]]
    )
    data = {}
    for row in range(n_units):
        for episode in range(4):
            u = np.repeat(rng.normal(size=(60, 1)), 10, axis=0)
            own = {"phase": phase[[row]]} if lifting.parameters else {}
            full = np.zeros((1, lifting.n_lifted, lifting.n_lifted + 1))
            full[0, :2] = W[row]
            x = free_run(full[..., :-1], full[..., -1:], lifting, own, rng.normal(size=(1, 2)), u[None])[0]
            data[EpisodeKey(f"u{row}", "default", str(episode))] = np.hstack(
                [x + noise * rng.standard_normal(x.shape), u]
            )
    parameters = {"phase": phase} if lifting.parameters else {}
    population, keys, factor = for_refinement(data, lifting, parameters)
    return population, keys, parameters, factor, W


def rows(models: KoopmanMatrices) -> np.ndarray:
    return np.concatenate([models.A, models.B], axis=-1)[:, :2]


@pytest.mark.parametrize("lifting", [KOOPMAN, LINEAR], ids=["koopman", "linear"])
def test_known_matrices_are_recovered_through_measurement_noise(lifting: Lifting) -> None:
    """Noise on the states biases one-step least squares; the free-run error does not suffer from it."""
    population, keys, parameters, factor, W = simulated(lifting, 3, 0.2, seed=3)
    models = refine_population(population, keys, lifting, parameters, factor, options=OPTIONS)
    p = lifting.n_lifted + 1
    R = factor.R
    one_step = np.swapaxes(np.linalg.solve(R[:, :p, :p], R[:, :p, p : p + 2]), 1, 2)
    assert np.abs(rows(models) - W).max() < 0.02
    assert np.abs(rows(models) - W).max() < 0.5 * np.abs(one_step - W).max()


def test_gradient_of_barrier_and_prior_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(1)
    T = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    W = np.array([[[0.95, 0.2, 0.3], [-0.2, 0.93, 1.0]]]) + 0.01 * rng.normal(size=(1, 2, 3))
    V = np.linalg.solve(T, np.swapaxes(W, 1, 2)).swapaxes(1, 2)
    square = np.array([[[0.5, 0.1, 0.3, 0.2], [-0.2, 0.6, 0.1, 1.0]]])
    prior = ResponsePrior(square[0, :, :2], square[0, :, 2:], np.eye(4), level=0.3)
    cases = [(lambda V: stability_barrier(V, T, 0.2, 3.0), V), (prior.normal, square * 1.03)]
    for evaluate, at in cases:
        numeric = np.zeros(at.size)
        for k in range(at.size):
            step = np.zeros(at.size)
            step[k] = 1e-6
            high, low = (evaluate(at + sign * step.reshape(at.shape))[0, -1, -1] for sign in (1, -1))
            numeric[k] = (high - low) / 2e-6
        np.testing.assert_allclose(-2 * evaluate(at)[0, :-1, -1], numeric, rtol=1e-4, atol=1e-6)


def test_stronger_priors_bring_units_closer_together() -> None:
    population, keys, parameters, factor, _ = simulated(KOOPMAN, 3, 0.02, seed=4)
    peaks = []
    for strength in (1e5, 1.0):
        options = replace(OPTIONS, strengths=(strength,))
        models = refine_population(population, keys, KOOPMAN, parameters, factor, options=options)
        peaks.append(peak_residual(models.A, models.B))
    assert peaks[0] < 0.7 * peaks[1]


def test_diverging_free_runs_name_unit_and_episode() -> None:
    population, keys, parameters, factor, _ = simulated(KOOPMAN, 2, 0.02, seed=6)
    tight = Factor(factor.R, factor.peak * 1e-3, factor.n_samples)
    with pytest.raises(IdentificationError, match=r"episode 0 of unit u0 .* reaches"):
        refine_population(
            population, keys, KOOPMAN, parameters, tight, options=RefineOptions(horizons=(5, 20), segments=4, bound=1.0)
        )


def exact(stiffness: float, period_s: float = 0.05) -> np.ndarray:
    """Return the matrices (A, B) of a mass of 1 kg on a spring, N/m, sampled with a hold."""
    return expm(np.array([[0.0, 1.0, 0.0], [-stiffness, -0.1, 1.0], [0.0, 0.0, 0.0]]) * period_s)[:2]


def masses_on_springs(stiffness: dict[str, float], period_s: float = 0.05, noise: float = 0.02) -> Population:
    """Recordings of masses of 1 kg on springs, N/m, with little damping."""
    rng, data = np.random.default_rng(0), {}
    for unit, k in stiffness.items():
        step = exact(k, period_s)
        for episode in range(3):
            u, x = np.repeat(rng.normal(size=50), 10), np.zeros((500, 2))
            for i in range(499):
                x[i + 1] = step @ [*x[i], u[i]]
            noisy = x + noise * rng.normal(size=x.shape)
            data[EpisodeKey(unit, "default", str(episode))] = np.column_stack([noisy, u])
    channels = Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE), Channel("force", Role.INPUT)
    return from_arrays(data, channels, period_s)


def test_a_unit_with_half_the_stiffness_keeps_its_resonance_and_others_theirs() -> None:
    """The resonance is ``sqrt(k / m)``; a prior that makes units alike would move all of them to one."""
    stiffness = {"a": 1.0, "b": 1.04, "soft": 0.5, "d": 0.97, "e": 1.01}
    models = identify(masses_on_springs(stiffness)).models("linear")
    poles = np.log(np.linalg.eigvals(models.A).astype(complex)) / models.sample_period_s
    true = np.sqrt([stiffness[unit] for unit in models.unit_ids])
    np.testing.assert_allclose(np.abs(poles).max(axis=1), true, rtol=0.01)


def test_machines_that_differ_widely_are_not_made_alike() -> None:
    """Little damping and noise of 2 % invite a strong prior; the spread of the true models is the oracle."""
    stiffness = {str(i): k for i, k in enumerate((1.0, 1.1, 0.9, 1.2, 0.8, 1.05))}
    models = identify(masses_on_springs(stiffness)).models("linear")
    true = np.stack([exact(k) for k in stiffness.values()])
    peaks = [peak_residual(A, B) for A, B in ((models.A, models.B), (true[..., :2], true[..., 2:]))]
    assert peaks[0] == pytest.approx(peaks[1], rel=0.1)  # noise moves models


def test_refined_models_do_not_depend_on_the_order_of_units() -> None:
    population = masses_on_springs({"a": 1.0, "b": 1.01, "c": 0.99, "d": 1.0, "soft": 0.5})
    order, models = population.unit_ids, {}
    for units in (order, order[::-1]):
        keys = {unit: population.keys(unit) for unit in units}
        refined = refine_population(population, keys, LINEAR, {}, unit_factors(population, keys, LINEAR))
        models[units] = dict(zip(units, refined.A, strict=True))
    first, second = models.values()
    np.testing.assert_allclose([first[u] for u in order], [second[u] for u in order], rtol=1e-6, atol=1e-6)
