"""Polish: gradients against finite differences, optima against Riccati equations and exhaustive search."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

from kros.core import ConfigError, StateSpace, SynthesisError, gain, h2_norm, hinf_norm
from kros.synthesis import GeneralizedPlant, Injection, ObserverProblem, h2, polish
from kros.synthesis.problem.plants import shaped_plant
from kros.synthesis.reduction.affine_loop import AffineLoop
from kros.synthesis.reduction.bounded_cost import BoundedCost
from kros.synthesis.reduction.certified_cost import CertifiedCost
from kros.synthesis.reduction.descent import bfgs
from kros.synthesis.worst_case.certificate import certify


def random_plant(rng, n=4, dt=1.0, **parts):
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    shapes = ((n, 3), (n, 2), (3, n), (2, n), (3, 3), (3, 2), (2, 3))
    return GeneralizedPlant(A, *(rng.standard_normal(s) for s in shapes), 0.1 * rng.standard_normal((2, 2)), dt, **parts)


def observer_problem(order=1, remainder=True):
    """Two states, one input, one measurement: small enough to search."""
    weight = StateSpace(0.8 * np.eye(order), np.ones((order, 1)), 0.05 * np.ones((1, order)), [[0.05]], 0.01)
    rest = {"remainder_left": gain(np.diag([0.02, 0.05]), 0.01), "remainder_right": gain([[1.0]], 0.01)} if remainder else {}
    return ObserverProblem(
        nominal=StateSpace([[1.0, 0.01], [-0.2, 0.97]], [[0.0], [0.06]], np.eye(2), np.zeros((2, 1)), 0.01),
        C=[[1.0, 0.0]],
        W_L=weight,
        W_R=gain([[1.0]], 0.01),
        input_scale=[1.0],
        output_scale=[1.0, 3.0],
        noise=[2e-3],
        injection=Injection.INPUT,
        **rest,
    )


def directional(function, theta, rng, step=1e-6):
    """Analytic and numerical derivative along a random direction."""
    direction = rng.standard_normal(theta.shape) * np.abs(theta).mean()
    _, gradient = function(theta)
    numerical = (function(theta + step * direction)[0] - function(theta - step * direction)[0]) / (2 * step)
    return float(np.sum(gradient * direction)), numerical


def test_gradients_against_finite_differences():
    rng = np.random.default_rng(0)
    plant = random_plant(rng, n_w1=2, n_z1=2)
    loop = AffineLoop(plant, 4)
    theta = loop.theta(h2(plant).controller) + 0.01 * rng.standard_normal((6, 6))
    closed = plant.close(loop.controller(theta))
    assert loop.close(theta).frequency_response([0.1]) == pytest.approx(closed.frequency_response([0.1]), rel=1e-9)
    bound = 1.3 * hinf_norm(plant.channel(plant.rows(2), plant.columns(2)).close(loop.controller(theta)))
    costs = (loop.h2_squared, BoundedCost.around(loop, theta, bound, 0.1))
    for cost in costs:
        analytic, numerical = directional(cost, theta, rng)
        assert analytic == pytest.approx(numerical, rel=1e-5)


@pytest.mark.parametrize("remainder", [False, True])
def test_gradient_of_the_certified_cost(remainder):
    rng = np.random.default_rng(1)
    problem = observer_problem(remainder=remainder)
    K = StateSpace([[0.5]], [[0.1]], [[0.05]], [[0.05]], 0.01)
    cost = CertifiedCost.around(problem, K)
    theta = cost.loop.theta(K)
    assert np.sqrt(cost(theta)[0]) == pytest.approx(certify(problem, problem.to_physical(K))[0], rel=1e-3)
    for _ in range(3):
        analytic, numerical = directional(cost, theta, rng, 1e-5)
        assert analytic == pytest.approx(numerical, rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_a_perturbed_optimum_returns_and_nothing_is_below_it(seed):
    rng = np.random.default_rng(seed)
    plant = random_plant(rng)
    optimum = h2(plant)
    assert polish(plant, optimum).h2_norm == pytest.approx(optimum.h2_norm, rel=1e-9)
    K = optimum.controller
    moved = StateSpace(*(getattr(K, m) + 0.02 * rng.standard_normal(getattr(K, m).shape) for m in "ABCD"), K.dt)
    assert h2_norm(plant.close(moved)) > 1.0005 * optimum.h2_norm
    found = polish(plant, replace(optimum, controller=moved), iterations=600)
    assert found.h2_norm == pytest.approx(optimum.h2_norm, rel=1e-6)
    assert found.h2_norm >= optimum.h2_norm * (1 - 1e-9)


def test_static_gain_under_a_bound_against_exhaustive_search():
    plant = GeneralizedPlant(
        [[0.95]],
        [[1.0, 0.0, 0.3]],
        [[1.0]],
        [[1.0], [0.0], [0.4]],
        [[1.0]],
        np.zeros((3, 3)),
        [[0.0], [0.5], [0.3]],
        [[0, 0.5, 0]],
        [[0]],
        1.0,
        2,
        2,
    )
    one, two = (plant.channel(plant.rows(i), plant.columns(i)) for i in (1, 2))

    def norms(k):
        return h2_norm(one.close(gain([[k]], 1.0))), hinf_norm(two.close(gain([[k]], 1.0)))

    gains = np.linspace(-1.5, 0.0, 76)
    loops = [norms(k) for k in gains]
    free, calmest = int(np.argmin([v for v, _ in loops])), int(np.argmin([norm for _, norm in loops]))
    bound = 0.5 * (loops[free][1] + loops[calmest][1])
    best = norms(brentq(lambda k: norms(k)[1] - bound, gains[free], gains[calmest], xtol=1e-6))[0]
    assert best > 1.005 * loops[free][0], "the bound should matter"
    start = replace(h2(plant), controller=gain([[gains[calmest]]], 1.0))
    found = polish(plant, start, bound=bound, iterations=40)
    assert found.h2_norm == pytest.approx(best, rel=2e-3)
    assert found.hinf_norm < bound
    assert polish(plant, start).h2_norm == pytest.approx(loops[free][0], rel=1e-3)


def test_static_observer_gain_against_exhaustive_search():
    problem = observer_problem()

    def value(k):
        try:
            return certify(problem, gain([[k]], 0.01))[0]
        except SynthesisError:
            return np.inf

    best = minimize_scalar(value, bounds=(0.0, 8.0), method="bounded").fun
    start = h2(shaped_plant(problem, gain([[1.0]], 0.01), gain(np.zeros((2, 0)), 0.01)), Injection.INPUT)
    start = replace(start, controller=gain([[0.2]], 0.01))
    found = polish(problem, start)
    assert value(0.2) > 1.01 * best
    assert found.worst_case_h2 <= best * (1 + 1e-4)
    assert found.worst_case_h2 == pytest.approx(certify(problem, found.controller)[0])
    assert "polished: certified worst-case H2" in found.notes[-1]


def test_descent_on_a_function_with_kinks_and_walls():
    def rosenbrock_with_a_kink(x):
        if x[0] > 1.2:
            return np.inf, np.zeros(2)
        r = x[1] - x[0] ** 2
        return 8 * abs(r) + (1 - x[0]) ** 2, np.array([-16 * np.sign(r) * x[0] - 2 * (1 - x[0]), 8 * np.sign(r)])

    found = bfgs(rosenbrock_with_a_kink, np.array([-1.2, 1.0]), 400, 1e-14)
    assert found == pytest.approx([1.0, 1.0], abs=1e-4)


def test_what_is_refused():
    plant = random_plant(np.random.default_rng(5))
    optimum = h2(plant)
    with pytest.raises(SynthesisError, match="does not stabilise"):
        polish(plant, replace(optimum, controller=gain(1e3 * np.ones((2, 2)), 1.0)))
    split = random_plant(np.random.default_rng(5), n_w1=2, n_z1=2)
    with pytest.raises(SynthesisError, match="below the bound"):
        polish(split, optimum, bound=1e-3)
    with pytest.raises(ConfigError, match="continuous"):
        polish(replace(plant, dt=0.0), optimum)
    with pytest.raises(ConfigError, match="rounds = 0"):
        polish(plant, optimum, rounds=0)
    with pytest.raises(ConfigError, match="bound is for general plants"):
        polish(observer_problem(), optimum, bound=1.0)
