"""Refinement of liftings with delays and input functions, against loops over samples and systems whose matrices are
known."""

from __future__ import annotations

import numpy as np
import pytest
from random_models import for_refinement

from kros.data import EpisodeKey
from kros.identify import KoopmanMatrices, free_run
from kros.identify.refine import RefineOptions, refine_population
from kros.identify.refine.segments import Segments
from kros.identify.refine.sensitivity import normal_equations
from kros.lifting import Lifting

DELAYED = Lifting(
    ("x", "i"), ("sin(3*x + phase)", "x[-4]", "i[-1]*u[-3]"), ("phase",), ("u", "w"), ("i*u", "cos(x[-2] + phase)*w")
)


def run_by_hand(W: np.ndarray, x: np.ndarray, u: np.ndarray, phase: float) -> np.ndarray:
    """Free run from the first five samples of x, written out."""
    x = x.copy()
    for k in range(4, len(x) - 1):
        lifted = [*x[k], np.sin(3 * x[k, 0] + phase), x[k - 4, 0], x[k - 1, 1] * u[k - 3, 0]]
        inputs = [*u[k], x[k, 1] * u[k, 0], np.cos(x[k - 2, 0] + phase) * u[k, 1]]
        x[k + 1] = W @ [*lifted, *inputs]
    return x


@pytest.mark.parametrize("stride", [1, 3])
def test_gradient_of_free_runs_with_delays_is_that_of_finite_differences(stride: int) -> None:
    rng = np.random.default_rng(0)
    units, segments, length, n, p = 2, 3, 22, 2, 9
    V = 0.25 * rng.normal(size=(units, n, p))
    T = np.eye(p) + 0.1 * rng.normal(size=(p, p))
    sigma, phase = np.array([0.5, 2.0]), np.array([0.3, 1.2])
    shape = (units, segments)
    data = Segments(
        rng.normal(size=(length, n, *shape)), rng.normal(size=(length, 2, *shape)), np.ones((length, *shape), bool), 4
    )
    data.valid[15:, 1, 2] = False
    compared = np.arange(4 + stride, length, stride)

    def cost(V: np.ndarray) -> np.ndarray:
        total = np.zeros(units)
        for i in range(units):
            for s in range(segments):
                x = run_by_hand(V[i] @ T.T, data.states[:, :, i, s], data.inputs[:, :, i, s], phase[i])
                error = (data.states[:, :, i, s] - x) / sigma
                total[i] += sum(np.sum(error[k] ** 2) for k in compared if data.valid[k, i, s])
        return total

    normal = normal_equations(V, T, DELAYED, {"phase": phase}, data, sigma, stride)
    np.testing.assert_allclose(normal.cost, cost(V), rtol=1e-10)
    assert normal.counts[0] == segments * len(compared)
    numeric = np.zeros((units, n * p))
    for k in range(n * p):
        step = np.zeros((n, p))
        step.flat[k] = 1e-6
        numeric[:, k] = (cost(V + step) - cost(V - step)) / 2e-6
    np.testing.assert_allclose(-2 * normal.matrix[:, :-1, -1], numeric, rtol=1e-5, atol=1e-5)


BILINEAR = Lifting(("x", "v"), ("sin(2*x[-3])", "u[-1]"), (), ("u",), ("v*u",))
W_TRUE = np.array([[0.97, 0.10, 0.03, 0.02, 0.01, 0.0], [-0.10, 0.88, -0.08, 0.10, 0.2, 0.15]])
OPTIONS = RefineOptions(horizons=(5, 20, 80), segments=10, strengths=(1e2, 1.0, 1e-2))


def machines(n_units: int, noise: float, seed: int, spread: float = 0.02) -> tuple:
    """Population, keys, factors and the true rows of the states (unit, 2, 6) of systems that BILINEAR describes
    exactly."""
    rng = np.random.default_rng(seed)
    W = W_TRUE * (1 + spread * rng.standard_normal((n_units, 1, 1)) * [[[0], [1]]])
    data = {}
    for row in range(n_units):
        for episode in range(4):
            u = rng.normal(size=(600, 1))  # changes at every sample, which tells u and u[-1] apart
            x = np.zeros((600, 2))
            x[:4] = 0.3 * rng.normal(size=(4, 2))
            for k in range(3, 599):
                x[k + 1] = W[row] @ [*x[k], np.sin(2 * x[k - 3, 0]), u[k - 1, 0], u[k, 0], x[k, 1] * u[k, 0]]
            data[EpisodeKey(f"u{row}", "default", str(episode))] = np.hstack(
                [x + noise * rng.standard_normal(x.shape), u]
            )
    return *for_refinement(data, BILINEAR, {}), W


def rows(models: KoopmanMatrices) -> np.ndarray:
    return np.concatenate([models.A, models.B], axis=-1)[:, :2]


def test_exact_recordings_give_the_exact_system_and_its_shift() -> None:
    population, keys, factor, W = machines(2, 0.0, seed=5, spread=0.0)
    models = refine_population(population, keys, BILINEAR, {}, factor, options=OPTIONS)
    np.testing.assert_allclose(rows(models), W, atol=1e-6)
    shift = np.concatenate([models.A, models.B], axis=-1)[:, 3]
    # u[-1] of the next sample is u
    np.testing.assert_allclose(shift, np.broadcast_to([0, 0, 0, 0, 1, 0], shift.shape), atol=1e-6)
    x = population.read(keys["u0"][0])
    run = free_run(models.A[:1], models.B[:1], BILINEAR, {}, x[None, :4, :2], x[None, :, 2:])[0]
    np.testing.assert_allclose(run, x[:, :2], atol=1e-5)
