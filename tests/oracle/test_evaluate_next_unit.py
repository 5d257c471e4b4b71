"""The next unit's bound against what order statistics say exactly, and against populations with many next units."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from kros.core.errors import DataError
from kros.evaluate.next_unit import draw_reserve, fewest_units, next_unit_bound


@pytest.mark.parametrize(
    ("confidence", "fewest"), [(0.95, 19), (0.9, 9), (0.99, 99), (0.5, 1), (0.8, 4), (0.75, 3), (2 / 3, 2)]
)
def test_fewer_units_than_the_confidence_needs_bound_nothing(confidence, fewest):
    errors = np.arange(float(fewest))[:, None]
    assert fewest_units(confidence) == fewest
    assert next_unit_bound(errors[1:], [1.0], confidence) is None
    assert next_unit_bound(errors, [1.0], confidence) == pytest.approx([fewest - 1])  # the largest of them


@pytest.mark.parametrize(
    ("n", "confidence", "rank"), [(19, 0.95, 19), (39, 0.95, 38), (20, 0.95, 20), (30, 0.9, 28), (9, 0.9, 9)]
)
def test_the_share_of_next_units_below_the_bound_has_the_distribution_of_an_order_statistic(n, confidence, rank):
    """Of uniform errors the bound is its own coverage: Beta(rank, n + 1 - rank), whose mean is at least the confidence."""
    rng = np.random.default_rng(n)
    covered = [next_unit_bound(rng.uniform(size=(n, 1)), [1.0], confidence)[0] for _ in range(4000)]
    exact = stats.beta(rank, n + 1 - rank)
    assert stats.kstest(covered, exact.cdf).pvalue > 0.01
    assert confidence <= exact.mean() + 1e-12 < confidence + 1 / (n + 1) + 1e-9


def test_errors_are_bounded_together_by_the_largest_scaled_one():
    errors = np.array([[1.0, 10.0], [2.0, 70.0], [6.0, 20.0], [4.0, 10.0]])  # scaled by (2, 20): 0.5, 3.5, 3, 2
    assert next_unit_bound(errors, [2.0, 20.0], 0.8) == pytest.approx([7.0, 70.0])
    assert next_unit_bound(errors, [2.0, 20.0], 0.6) == pytest.approx([6.0, 60.0])
    assert np.isinf(next_unit_bound([[1.0], [np.nan], [2.0], [3.0]], [1.0], 0.8)).all()
    assert next_unit_bound([[1.0], [np.nan], [2.0], [3.0]], [1.0], 0.6) == pytest.approx([3.0])


@pytest.mark.parametrize("scale", [[0.0], [np.inf]])
def test_scales_that_are_none(scale):
    with pytest.raises(DataError, match="Bound of the next unit"):
        next_unit_bound(np.ones((30, 1)), scale, 0.9)


def test_the_draw_knows_places_alone_and_grows():
    units = [f"u{i}" for i in range(40)]
    drawn = [set(draw_reserve(units, n)) for n in range(41)]
    assert [len(d) for d in drawn] == list(range(41))
    assert all(small < large for small, large in pairwise(drawn))
    assert drawn[7] == {units[int(name[1:])] for name in draw_reserve([f"v{i}" for i in range(40)], 7)}
    first = [draw_reserve(units[:5], 1, seed)[0] for seed in range(2000)]
    assert stats.chisquare([first.count(u) for u in units[:5]]).pvalue > 0.01


def kalman_gain(A, C):
    """Return the gain of a Kalman predictor."""
    P = np.eye(len(A))
    for _ in range(200):
        S = C @ P @ C.T + 1e-2
        K = A @ P @ C.T / S
        P = A @ P @ A.T - K @ C @ P @ A.T + np.diag([1e-3, 1e-2, 1e-2])
    return K


def simulated(rng, shape, n_samples=120):
    """Masses on springs with a filtered force, all units at once: recorded states and inputs, samples first, of random parameters."""
    spread = np.exp(rng.normal(scale=[0.2, 0.4, 0.2, 0.1], size=(*shape, 4)))  # stiffness, damping, gain, lag
    A = np.zeros((*shape, 3, 3))
    A[..., 0, 0], A[..., 0, 1] = 1, 0.1
    A[..., 1, 0], A[..., 1, 1], A[..., 1, 2] = -0.3 * spread[..., 0], 1 - 0.1 * spread[..., 1], 0.1
    A[..., 2, 2] = np.exp(-0.2 * spread[..., 3])
    B = np.stack([0 * spread[..., 2], 0 * spread[..., 2], spread[..., 2]], axis=-1)
    u = rng.normal(size=(n_samples, *shape))
    x, states = np.zeros((*shape, 3)), np.empty((n_samples, *shape, 3))
    for k in range(n_samples):
        states[k] = x
        x = np.einsum("...ij,...j->...i", A, x) + B * u[k][..., None] + 0.01 * rng.normal(size=x.shape)
    return states, u


def errors_of(A, b, K, states, u):
    """Return the error of observers, in RMS of both hidden states; a population each."""
    estimate, total = np.zeros(states.shape[1:]), np.zeros(states.shape[1:])
    for x, force in zip(states, u, strict=True):
        total += (estimate - x) ** 2
        corrected = (x - estimate)[..., :1] * K[:, None]
        estimate = np.einsum("pij,puj->pui", A, estimate) + b[:, None] * force[..., None] + corrected
    return np.sqrt(total / len(states))[..., 1:]


def test_the_next_units_of_two_hundred_populations_are_covered():
    """Fifty new units each, two hidden states together; the exact null distribution is a sum of beta-binomials."""
    populations, made_from, reserve, new, confidence = 200, 5, 19, 50, 0.95
    rng = np.random.default_rng(20)
    states, u = simulated(rng, (populations, made_from + reserve + new))
    psi = np.concatenate([states, u[..., None]], axis=-1)[:-1, :, :made_from]
    psi, after = (np.moveaxis(v, 0, 2).reshape(populations, -1, v.shape[-1]) for v in (psi, states[1:, :, :made_from]))
    models = np.linalg.solve(np.swapaxes(psi, 1, 2) @ psi, np.swapaxes(psi, 1, 2) @ after).swapaxes(1, 2)
    A, b = models[..., :3], models[..., 3]
    K = np.stack([kalman_gain(m, np.eye(1, 3))[:, 0] for m in A])
    errors = errors_of(A, b, K, states, u)
    scale = errors[:, :made_from].mean(axis=1)
    bounds = np.stack(
        [next_unit_bound(e, s, confidence) for e, s in zip(errors[:, made_from:-new], scale, strict=True)]
    )
    inside = (errors[:, -new:] <= bounds[:, None]).all(axis=2).sum(axis=1)

    rank = round(confidence * (reserve + 1))
    null = stats.betabinom(new, rank, reserve + 1 - rank)  # units of one population share their bound
    total = np.array([1.0])
    for _ in range(populations):
        total = np.convolve(total, null.pmf(np.arange(new + 1)))
    assert total[: inside.sum() + 1].sum() > 0.01
    assert total[inside.sum() :].sum() > 0.01  # nor is it too wide: errors have no ties
    assert errors[:, made_from:].mean() > 1.02 * scale.mean()  # what the design units say of themselves is too little
