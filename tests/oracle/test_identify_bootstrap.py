"""Uncertainty of the estimate against repeated experiments on a known system, and against refits on resampled
episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kros.identify import (
    Factor,
    KoopmanMatrices,
    ModelSamples,
    bootstrap_edmd,
    combine,
    episode_factors,
    episode_weights,
)
from kros.identify.bootstrap import bootstrap_refined, one_step_deviations
from kros.identify.factors import Ranges
from kros.identify.refine import GaussNewton, Refinement, RefineOptions, refine_population
from kros.identify.refine.episodes import episode_normals
from kros.identify.refine.metric import ResponsePrior
from kros.identify.refine.model import TrainingData
from kros.identify.refine.problem import OneStep, RefinementProblem
from kros.identify.refine.segments import Segments, read_segments, segment_owners
from kros.lifting import Lifting
from kros.plants import HarmonicDrivePopulation

TRUE = np.array([[0.8, 0.3, 0.0], [-0.3, 0.7, 0.5]])
DT = 0.01


def data_sets(count: int, episodes: int, samples: int, seed: int) -> np.ndarray:
    """Factors of [Psi | Theta_plus] of independently simulated data sets, (data set, episode, 5, 5), white process
    noise."""
    rng = np.random.default_rng(seed)
    x = np.zeros((samples, count, episodes, 2))
    x[0] = rng.normal(size=x.shape[1:])
    u = rng.normal(size=(samples, count, episodes, 1))
    for k in range(samples - 1):
        x[k + 1] = np.concatenate([x[k], u[k]], axis=-1) @ TRUE.T + 0.3 * rng.normal(size=x.shape[1:])
    rows = np.concatenate([x[:-1], u[:-1], x[1:]], axis=-1)
    return np.linalg.qr(np.moveaxis(rows, 0, 2), mode="r")


def of(models: ModelSamples) -> np.ndarray:
    return np.concatenate([models.estimate.A, models.estimate.B], axis=-1).reshape(len(models.unit_ids), -1)


def bands(
    models: ModelSamples, freqs: np.ndarray, dt: float, output_scale: Any, input_scale: Any, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Quantiles over the draws of sigma_max of the scaled deviation, and of every entry's magnitude: (unit,
    frequency[, n, m])."""
    off = (
        np.stack([models.responses(row, freqs, dt) for row in range(len(models.unit_ids))])
        - models.estimate.responses(freqs, dt)[:, None]
    )
    spectral = np.linalg.norm(off * input_scale / np.asarray(output_scale)[:, None], ord=2, axis=(-2, -1))
    return np.quantile(spectral, level, axis=1), np.quantile(np.abs(off), level, axis=1)


@pytest.mark.parametrize("alpha", [0.0, 200.0])
def test_covariance_of_resampled_models_is_that_of_repeated_experiments(alpha: float) -> None:
    """Units stand for experiments. 1500 of them know a variance to 3.7 percent and a correlation to 0.026 (one
    standard error)."""
    R = data_sets(1500, 12, 60, seed=0)
    models = bootstrap_edmd(R, 2, alpha, episode_weights([12] * 1500, 60, seed=1))
    W = np.concatenate([models.samples.A, models.samples.B], axis=-1).reshape(1500, 60, -1)
    W = W - W.mean(axis=1, keepdims=True)
    repeated, found = np.cov(of(models).T), np.einsum("uda,udb->ab", W, W) / (59 * 1500)
    scale = np.sqrt(np.diagonal(repeated))
    np.testing.assert_allclose(np.diagonal(found), np.diagonal(repeated), rtol=4 * np.sqrt(2 / 1499))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), repeated / np.outer(scale, scale), atol=4 * np.sqrt(2 / 1499)
    )


def test_bands_hold_the_truth_as_often_as_they_say() -> None:
    """800 experiments know a share of 0.9 to 0.011. Thirty episodes know a variance to 26 percent, which costs the
    band some of its
    coverage (Student's t with 29 degrees of freedom: 0.89), and the quantile of 200 draws about as much."""
    R = data_sets(800, 30, 30, seed=2)
    models = bootstrap_edmd(R, 2, 0.0, episode_weights([30] * 800, 200, seed=3))
    scale_out, scale_in = np.array([2.0, 0.5]), np.array([3.0])
    freqs = np.array([0.1, 5.0, 15.0, 45.0])
    spectral, entry = bands(models, freqs, DT, scale_out, scale_in, level=0.9)
    truth = np.array(
        [np.linalg.solve(x * np.eye(2) - TRUE[:, :2], TRUE[:, 2:]) for x in np.exp(2j * np.pi * freqs * DT)]
    )
    off = models.estimate.responses(freqs, DT) - truth
    inside = np.linalg.norm(off * scale_in / scale_out[:, None], ord=2, axis=(-2, -1)) <= spectral
    coverage = np.concatenate([inside.mean(axis=0), (np.abs(off) <= entry).mean(axis=0).ravel()])
    assert coverage.shape == (4 + 8,)
    assert coverage.min() > 0.9 - 0.02 - 4 * 0.011
    assert coverage.max() < 0.9 + 4 * 0.011


def test_one_gauss_newton_step_is_exact_where_the_cost_is_quadratic() -> None:
    """Ridge regression as a cost of episodes plus a prior: a step on weighted episodes is the weighted solution
    itself."""
    rng = np.random.default_rng(4)
    J, y = rng.normal(size=(3, 5, 20, 4)), rng.normal(size=(3, 5, 20))  # unit, episode, sample, parameter
    weights = episode_weights([5, 5, 5], 7, seed=5)

    def solve(w: np.ndarray, row: int) -> np.ndarray:
        H = np.einsum("e,esp,esq->pq", w, J[row], J[row]) + 2.0 * np.eye(4)
        return np.linalg.solve(H, np.einsum("e,esp,es->p", w, J[row], y[row]))

    V = np.stack([solve(np.ones(5), row) for row in range(3)])
    rest = y - np.einsum("uesp,up->ues", J, V)
    rows = np.concatenate([J, rest[..., None]], axis=-1)
    normal = np.swapaxes(rows, -1, -2) @ rows
    information = normal[..., :-1, :-1].sum(axis=1) + 2.0 * np.eye(4)
    found = V[:, None] + one_step_deviations(normal, information, weights)
    expected = [[solve(w, row) for w in weights[row]] for row in range(3)]
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


# refined models of simulated drives

STATES = ("position", "velocity", "current")
KOOPMAN = Lifting(STATES, ("sin(100*position + phase)",), ("phase",))
OPTIONS = RefineOptions(horizons=(5, 20, 80), segments=20, strengths=(10.0,), search=GaussNewton(iterations=10))
EPISODES = 5


@pytest.fixture(scope="module")
def drives() -> tuple[KoopmanMatrices, Refinement, Factor, np.ndarray, RefinementProblem]:
    """Refined models of three drives, their per-episode factors and normal equations, and the problem that they solve,
    divided by ranges."""
    simulated = HarmonicDrivePopulation(n_units=3, n_episodes=EPISODES, seconds=4.0, conditions=("noload",)).simulate()
    population, phase = simulated.population, {"phase": simulated.truth.phase_rad}
    keys = {unit: population.keys(unit) for unit in population.unit_ids}
    recorded = episode_factors(population, keys, KOOPMAN, phase)
    span = Ranges.of(combine(recorded), 4)
    models, refinement = refine_population(population, keys, KOOPMAN, phase, combine(recorded), options=OPTIONS)
    models, refinement = span.normalise(models), refinement.divided_by(span)
    data = TrainingData(population, keys, KOOPMAN, phase, recorded, np.ones(3, bool)).divided_by(span)
    T, lifting = refinement.whitening, data.lifting
    segments = read_segments(data.population, keys, max(OPTIONS.horizons), OPTIONS.segments, OPTIONS.seed)
    one_step = OneStep.of(combine(data.factor), T, 3, np.arange(3))
    prior = ResponsePrior(refinement.pooled.A, refinement.pooled.B, T, OPTIONS.prior_level, OPTIONS.prior_power)
    problem = RefinementProblem(lifting, phase, segments, T, refinement.sigma, one_step, OPTIONS, False, True, prior)
    problem = problem.with_prior(refinement.strength)
    # Refits compare minima, so the models are first taken all the way to theirs.
    search = GaussNewton(iterations=60, least_gain=1e-12)
    V = settle(problem.evaluate, search.minimise(problem.evaluate, problem.admissible, whitened(models, T)).V)
    W = V @ T.T
    models = KoopmanMatrices(W[..., :4], W[..., 4:])
    refinement = replace(refinement, information=problem.evaluate(V)[:, :-1, :-1])
    return models, refinement, data.factor, episode_normals(models, refinement, data, OPTIONS), problem


def settle(evaluate: Callable[[np.ndarray], np.ndarray], V: np.ndarray) -> np.ndarray:
    """Gauss-Newton steps from near a minimum until the gradient is gone: a search that watches the cost stops at its
    rounding before."""
    for _ in range(40):
        matrix = evaluate(V)
        scale = 1 / np.sqrt(np.diagonal(matrix[:, :-1, :-1], axis1=1, axis2=2))
        H, g = matrix[:, :-1, :-1] * scale[:, :, None] * scale[:, None], matrix[:, :-1, -1] * scale
        V = V + (np.linalg.solve(H, g[..., None])[..., 0] * scale).reshape(V.shape)
    return V


def whitened(models: KoopmanMatrices, T: np.ndarray) -> np.ndarray:
    W = np.concatenate([models.A, models.B], axis=-1)
    return np.swapaxes(np.linalg.solve(T, np.swapaxes(W, -1, -2)), -1, -2)


def test_one_step_is_the_derivative_of_the_refit(drives: tuple) -> None:
    """Weights that differ from one by up to 0.06: models and refits agree but for what Gauss-Newton leaves out of the
    curvature."""
    models, refinement, factors, normal, problem = drives
    T, information = refinement.whitening, refinement.information
    counts = np.array([[2.0, 1, 2, 0, 0], [0, 3, 0, 1, 1], [1, 0, 2, 2, 0]])
    small = 1 + 0.03 * (counts - 1)
    step = bootstrap_refined(models, T, information, normal, small[:, None], "abc").samples
    start = whitened(models, T)
    moved = whitened(KoopmanMatrices(step.A[:, 0], step.B[:, 0]), T) - start
    data, drawn = replace(problem, prior=None, edged=False), resampled(factors, problem, counts)

    def evaluate(V: np.ndarray) -> np.ndarray:
        return problem.evaluate(V) + 0.03 * (drawn.evaluate(V) - data.evaluate(V))

    expected = settle(evaluate, start) - start
    root = np.linalg.cholesky(information)
    a, b = (np.einsum("upq,up->uq", root, d.reshape(3, -1)) for d in (moved, expected))
    assert (np.linalg.norm(a - b, axis=1) < 0.3 * np.linalg.norm(b, axis=1)).all()
    assert (np.sum(a * b, axis=1) > 0.95 * np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)).all()


def resampled(factors: Factor, problem: RefinementProblem, counts: np.ndarray) -> RefinementProblem:
    """The problem without prior and edge on so many copies of every episode, (unit, episode)."""
    owners = segment_owners({f"u{i}": tuple(range(EPISODES)) for i in range(3)}, OPTIONS.segments)
    picks = [
        np.concatenate([np.repeat(np.flatnonzero(owners[i] == e), int(w)) for e, w in enumerate(counts[i])])
        for i in range(3)
    ]
    whole = (problem.segments.states, problem.segments.inputs, problem.segments.valid)
    chosen = Segments(*(np.stack([a[..., i, pick] for i, pick in enumerate(picks)], axis=-2) for a in whole))
    R = (np.sqrt(counts)[..., None, None] * factors.R).reshape(3, -1, factors.R.shape[-1])
    drawn = Factor(np.linalg.qr(R, mode="r"), factors.peak, (counts * factors.n_samples).sum(axis=1))
    matrix = OneStep.of(drawn, problem.T, 3, np.arange(3)).matrix
    return replace(problem, segments=chosen, one_step=replace(problem.one_step, matrix=matrix), prior=None, edged=False)
