"""Observers and baselines in any units of measure: the same estimates, told in these units."""

from __future__ import annotations

import numpy as np
import pytest
from batches import batch_of
from machines import filters

from kros.core.lti import StateSpace
from kros.lifting import Lifting
from kros.observer import Observer, ReliftScales, Runtime, relift_certificate, run_observer
from kros.observer.baselines.difference import FilteredDifference, followed
from kros.observer.residual import least_squares
from kros.observer.units import in_sizes
from kros.synthesis import Injection

DT = 0.01
LIFTING = Lifting(("x", "v"), ("sin(x)",), (), ("u",))
SIZES = {"x": 1e9, "v": 3e-9, "u": 2e5, "sin(x)": 0.7}


def observer(injection=Injection.STATE, runtime=None):
    rng = np.random.default_rng(4)
    A = np.array([[0.9, 0.05, -0.02], [-0.1, 0.8, -0.05], [0.1, 0.1, 0.3]])
    B, width = np.array([[0.01], [0.2], [0.05]]), 1 if injection is Injection.INPUT else 3
    K = StateSpace([[0.5]], [[1.0]], rng.normal(size=(width, 1)) * 0.1, rng.normal(size=(width, 1)) * 0.2, DT)
    return Observer("o", LIFTING, A, B, (0,), ("u",), K, injection, DT, runtime=runtime or Runtime())


RUNTIMES = [
    Runtime(),
    Runtime(lower=np.array([-0.2, -0.5]), upper=np.array([0.3, np.inf]), delay=2),
    Runtime(start=np.array([0.0, 2.0])),
]


@pytest.mark.parametrize("injection", [Injection.STATE, Injection.INPUT])
@pytest.mark.parametrize("runtime", RUNTIMES, ids=["plain", "limits", "start"])
def test_estimates_in_other_sizes_are_the_same(injection, runtime):
    one, rng = observer(injection, runtime), np.random.default_rng(0)
    other = in_sizes(one, SIZES)
    y, u = rng.normal(size=(200, 3, 1)), rng.normal(size=(200, 3, 1))
    y[50:60] = np.nan
    found = run_observer(other, y / 1e9, u / 2e5)
    np.testing.assert_allclose(found * [1e9, 3e-9], run_observer(one, y, u), rtol=1e-6, atol=1e-9)
    back = in_sizes(other, {})
    assert back.lifting == one.lifting
    for name in "AB":
        np.testing.assert_allclose(getattr(back, name), getattr(one, name), rtol=1e-12)


def test_a_filter_bank_bridges_gaps_in_any_units():
    one, rng = filters(), np.random.default_rng(0)
    sizes = {"position": 0.01, "velocity": 60.0, "current": 3e3, "target": 7.0, "rate": 0.2}
    y, u = rng.normal(size=(200, 3, 1)), rng.normal(size=(200, 3, 2))
    y[20:60, 0], y[100:180, 1], y[rng.random((200, 3)) < 0.3] = np.nan, np.nan, np.nan
    y[0] = 0.1
    phase = {"phase": np.zeros(3)}
    found = run_observer(in_sizes(one, sizes), y / sizes["position"], u / [sizes["target"], sizes["rate"]], phase)
    wanted = run_observer(one, y, u, phase)[..., :3]
    # slopes of a gear magnify rounding
    np.testing.assert_allclose(found[..., :3] * [0.01, 60.0, 3e3], wanted, rtol=1e-9, atol=1e-8)


def test_the_certificate_says_the_same_in_other_sizes():
    one, box = observer(), {"x": (-1.0, 2.0)}
    scales = ReliftScales(np.array([2.0, 3.0]), np.array([0.1, 0.2]), np.array([0.01]))
    found = relift_certificate(
        in_sizes(one, {"x": 2.0, "v": 3.0}),
        {"x": (-0.5, 1.0)},
        ReliftScales(np.ones(2), np.array([0.05, 0.2 / 3]), np.array([0.005])),
    )
    direct = relift_certificate(one, box, scales)
    told = found.in_units(in_sizes(one, {"x": 2.0, "v": 3.0}))
    assert all(found.certified for found in (direct, told))
    assert told.gain == pytest.approx(direct.gain, rel=0.02)  # a proof stops within two percent of the least gain
    assert told.assumptions == direct.assumptions
    np.testing.assert_allclose(told.scales.error, scales.error)
    np.testing.assert_allclose(told.scales.residual, scales.residual)
    error = np.array([0.4, -0.3])
    V = [c.root @ c.start[:, :2] @ e for c, e in ((told, error), (found, error / [2.0, 3.0]))]
    np.testing.assert_allclose(V[0] @ V[0], V[1] @ V[1])
    assert told.system(one).frozen(np.ones(1)).A.shape == (3, 3)


def signals(seed=3):
    """Position with quantisation, its rate and something else."""
    t, rng = np.arange(3000) * DT, np.random.default_rng(seed)
    x = np.stack([np.sin(t), np.sin(1.7 * t + 1)], axis=1)
    v = np.stack([np.cos(t), 1.7 * np.cos(1.7 * t + 1)], axis=1)
    return np.stack([np.rint(x * 1e4) / 1e4, v, rng.normal(size=x.shape)], axis=-1)


@pytest.mark.parametrize("factors", [(1, 1, 1), (180 / np.pi, 30 / np.pi, 1), (1e-9, 1e9, 1e9), (1e9, 1e-9, 1)])
def test_the_filtered_difference_learns_pair_and_scale(factors):
    states = signals()
    scaled = states * factors
    batch = batch_of(scaled, scaled[..., :0], DT, lengths=[3000, 2500])
    assert followed(batch, (0,)) == ((0, 1),)
    plain = FilteredDifference(3, ((0, 1),), 20.0, DT).scaled_to(batch, (0,))
    assert plain.scales[0] == pytest.approx(factors[1] / factors[0], rel=0.02)
    found = plain.run(scaled[..., :1], scaled[..., :0])[..., 1] / factors[1]
    assert np.abs(found[100:] - states[100:, :, 1]).max() < 0.1


def test_what_is_no_rate_is_not_taken_for_one():
    states = signals()
    assert followed(batch_of(states, states[..., :0], DT), (2,)) == ()
    assert followed(batch_of(states[..., :2], states[..., :0], DT), (0, 1)) == ()


def test_least_squares_decides_about_rank_in_units_of_every_column():
    rng = np.random.default_rng(1)
    rows, values = rng.normal(size=(100, 3)), rng.normal(size=(100, 2))
    factors = np.array([1e9, 1e-9, 1e-170])
    expected = np.linalg.lstsq(rows, values, rcond=None)[0]
    np.testing.assert_allclose(least_squares(rows * factors, values) * factors[:, None], expected, rtol=1e-9)
    assert not least_squares(np.zeros((5, 2)), values[:5]).any()
