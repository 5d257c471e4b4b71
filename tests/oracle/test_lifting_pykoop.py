"""Where the definitions agree, pykoop's lifting functions give the same columns, and its EDMD the same models.

pykoop solves normal equations, so models are compared to 1e-8 on data of one scale; columns are compared to rounding.
"""

import numpy as np
import pytest

from kros.identify import combine, edmd
from kros.identify.factors import Factor, lifted_factor, reduce_episode
from kros.lifting import Lifting, delays, polynomials, radial

pykoop = pytest.importorskip("pykoop")
STATES, INPUTS = ("x0", "x1"), ("u0",)
SHAPE = 0.8  # pykoop's radius is the distance times this


def episodes(n=3):
    rng = np.random.default_rng(0)
    found = []
    for length in (60, 45, 80)[:n]:
        u, x = rng.normal(size=(length, 1)), np.zeros((length, 2))
        x[0] = rng.normal(size=2)
        for k in range(length - 1):
            x[k + 1] = [0.8 * x[k, 0] + 0.2 * np.tanh(x[k, 1]), 0.7 * x[k, 1] - 0.3 * np.sin(x[k, 0]) + 0.4 * u[k, 0]]
        found.append((x, u))
    return found


def table(parts):
    """pykoop's array: episode, states, inputs."""
    return np.vstack([np.column_stack([np.full(len(x), i), x, u]) for i, (x, u) in enumerate(parts)])


BILINEAR = ("x0*u0", "x1*u0")
CASES = {
    "polynomials": (
        lambda: pykoop.PolynomialLiftingFn(order=3),
        Lifting(
            STATES,
            polynomials(STATES, 3),
            (),
            INPUTS,
            (*BILINEAR, "u0**2", "x0**2*u0", "x0*x1*u0", "x0*u0**2", "x1**2*u0", "x1*u0**2", "u0**3"),
        ),
    ),
    "delays": (lambda: pykoop.DelayLiftingFn(n_delays_state=3), Lifting(STATES, delays(STATES, 3))),
    "delayed inputs": (
        lambda: pykoop.DelayLiftingFn(n_delays_state=1, n_delays_input=2),
        Lifting(STATES, delays(STATES, 1), (), INPUTS, delays(INPUTS, 2)),
    ),
    "bilinear": (pykoop.BilinearInputLiftingFn, Lifting(STATES, (), (), INPUTS, BILINEAR)),
}


@pytest.mark.parametrize("name", CASES)
def test_columns_and_models_are_those_of_pykoop(name):
    make, lifting = CASES[name]
    parts, alpha = episodes(), 0.5
    pipeline = pykoop.KoopmanPipeline(lifting_functions=[("lift", make())], regressor=pykoop.Edmd(alpha=alpha))
    X = table(parts)
    pipeline.fit(X, n_inputs=1, episode_feature=True)
    theirs = pipeline.transform(X)[:, 1:]
    # pykoop drops as many samples of every episode as its deepest delay, of states or inputs
    ours = []
    for x, u in parts:
        windows = lifting.windows(x, u)
        ours.append(np.hstack([lifting.lift(windows), lifting.lift_inputs(u[lifting.history :], windows)]))
    ours = np.vstack(ours)
    assert ours.shape == theirs.shape
    n = lifting.n_lifted
    order = np.array([int(np.argmin(np.abs(theirs - column[:, None]).sum(axis=0))) for column in ours.T])
    assert sorted(order) == list(range(theirs.shape[1]))
    np.testing.assert_allclose(ours, theirs[:, order], rtol=1e-12, atol=1e-14)

    factor = combine(Factor.stack([reduce_episode(x, u, lifting) for x, u in parts]))
    found = edmd(lifted_factor(factor, lifting, {}, lifting).R, n, alpha)
    U = pipeline.regressor_.coef_.T[np.ix_(order[:n], order)]
    np.testing.assert_allclose(np.hstack([found.A, found.B]), U, rtol=1e-8, atol=1e-9)


def test_radial_functions_are_those_of_pykoop():
    """pykoop's Gaussian is exp(-r**2) with r = shape*distance, ours exp(-s**2/2) with s = distance/length."""
    length, centres = 1 / SHAPE / np.sqrt(2), np.random.default_rng(1).uniform(-2, 2, (6, 2))
    X = np.vstack([x for x, _ in episodes()])
    theirs = pykoop.RbfLiftingFn(rbf="gaussian", centers=pykoop.DataCenters(centres), shape=SHAPE, offset=0)
    expected = theirs.fit(X, n_inputs=0, episode_feature=False).transform(X)
    found = Lifting(STATES, radial(STATES, centres, length)).lift(X)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-13)
