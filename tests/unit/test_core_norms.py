"""System norms: infinite values, invariance, bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kros.core import DimensionError, KrosError, StateSpace, gain, h2_norm, hinf_norm


@pytest.mark.parametrize(("pole", "dt"), [(1.0, 1.0), (-1.2, 1.0), (0.0, 0.0), (0.5, 0.0)])
def test_unstable_systems_have_infinite_norms(pole, dt):
    system = StateSpace([[pole]], [[1.0]], [[1.0]], [[0.0]], dt)
    assert h2_norm(system) == np.inf
    assert hinf_norm(system) == np.inf


def test_continuous_feedthrough_has_infinite_h2_norm_only():
    system = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[1.0]], 0.0)
    assert h2_norm(system) == np.inf
    assert hinf_norm(system) == pytest.approx(2)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_norms_do_not_depend_on_coordinates(seed, n):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    T, _ = np.linalg.qr(rng.standard_normal((n, n)))
    T = T * rng.uniform(0.1, 10, n)
    B, C, D = rng.standard_normal((n, 2)), rng.standard_normal((2, n)), rng.standard_normal((2, 2))
    one = StateSpace(A, B, C, D, 1.0)
    other = StateSpace(np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T, D, 1.0)
    assert h2_norm(other) == pytest.approx(h2_norm(one), rel=1e-6)
    assert hinf_norm(other) == pytest.approx(hinf_norm(one), rel=1e-5)


def test_zero_and_empty_systems():
    assert hinf_norm(StateSpace([[0.5]], [[0.0]], [[1.0]], [[0.0]], 1.0)) == 0
    assert hinf_norm(StateSpace(np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((1, 0)), np.zeros((1, 0)), 1.0)) == 0


def test_bad_input_is_named():
    batch = StateSpace(np.zeros((3, 1, 1)), np.ones((3, 1, 1)), np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 1.0)
    with pytest.raises(DimensionError, match=r"batch of shape \(3,\)"):
        h2_norm(batch)
    with pytest.raises(DimensionError, match="ndarray"):
        hinf_norm(np.eye(2))
    with pytest.raises(KrosError, match="NaN"):
        hinf_norm(gain([[np.nan]], 1.0))
    with pytest.raises(KrosError, match="tol"):
        hinf_norm(gain([[1.0]], 1.0), tol=0)
