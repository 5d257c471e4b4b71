"""Starts in motion: against the Kalman filter that does not know where it starts, against loops, and within certificates."""

from dataclasses import replace

import numpy as np
import pytest
from batches import batch_of
from machines import MACHINES, moving, samples
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from kros.core.lti import gain
from kros.lifting import Lifting
from kros.observer import Observer, run_observer
from kros.observer.predictor.start import with_start
from kros.observer.simulate import started
from kros.observer.units import in_sizes
from kros.synthesis import Injection

DT = 0.01


def test_gains_are_those_of_a_kalman_filter_that_starts_anywhere():
    """The filter's gains follow from the covariance of the states, known exactly here; they are found from recordings."""
    A, C = np.array([[0.9, 0.3, 0.0], [-0.2, 0.8, 0.1], [0.0, 0.0, 0.95]]), np.array([[1.0, 0.0, 0.0]])
    Q, R, rng = np.diag([1e-4, 1e-2, 1e-2]), 0.05, np.random.default_rng(0)
    P = solve_discrete_are(A.T, C.T, Q, np.array([[R]]))
    L = A @ P @ C.T / (C @ P @ C.T + R)
    o = Observer("k", Lifting(("a", "b", "c"), ()), A, np.zeros((3, 1)), (0,), ("u",), gain(L, DT), Injection.STATE, DT)
    x = np.zeros((900, 60, 3))
    x[0] = rng.multivariate_normal(np.zeros(3), solve_discrete_lyapunov(A, Q), 60)
    for k in range(899):
        x[k + 1] = x[k] @ A.T + rng.normal(size=(60, 3)) * np.sqrt(np.diag(Q))
    y = x.copy()
    y[..., 0] += np.sqrt(R) * rng.normal(size=y.shape[:2])
    found = with_start(o, replace(batch_of(x, np.zeros((900, 60, 1)), DT), shown=y), count=6).start_in_motion
    V, closed = solve_discrete_lyapunov(A, Q), A - L @ C
    power, known = float((C @ V @ C.T)[0, 0]) + R, V - P  # of measurements, and of what the running filter predicts
    g = np.vstack([[[1.0]], (known @ C.T)[1:] / power])
    D = known - g @ (known @ C.T).T - (known @ C.T) @ g.T + power * g @ g.T  # of what the start misses of that
    np.testing.assert_allclose(found.gain[1:, 0], g[1:, 0], atol=0.05 * np.abs(g[1:]).max())
    np.testing.assert_array_equal(found.corrections[0], 0.0)  # the first innovation is zero
    D = closed @ D @ closed.T
    for k in range(1, 6):
        c, power = closed @ D @ C.T, float((C @ (D + P) @ C.T)[0, 0]) + R
        S = c / power
        S[0] = 0.0  # hidden states are corrected
        spread = np.sqrt(
            np.diag(D) / power / 1500
        )  # standard errors of a regression on as many independent windows; there are 2000
        assert (np.abs(found.corrections[k] - S)[:, 0] < 4 * spread).all()
        D = closed @ D @ closed.T - S @ c.T - c @ S.T + power * S @ S.T


@pytest.mark.parametrize("kind", [k for k in MACHINES if "motion" in k])
def test_batched_and_single_runs_agree_after_starts_gaps_and_faults(kind):
    o, (y, u) = MACHINES[kind](), samples(600)
    for first in (0, 1):  # at a measurement that is missing, and at one that is there
        batch = run_observer(o, y[first:, None], u[first:, None])[:, 0]
        running = o.start(y[first])
        single = [np.asarray(running.step(*sample)) for sample in zip(y[first:], u[first:], strict=True)]
        np.testing.assert_allclose(batch[1:], single[:-1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", [k for k in MACHINES if "motion" in k])
def test_files_and_units_of_measure_keep_the_start(kind, tmp_path):
    o, (y, u) = MACHINES[kind](), samples(60, faults=False)
    o.save(tmp_path / "o.json")
    np.testing.assert_array_equal(
        run_observer(Observer.load(tmp_path / "o.json"), y[:, None], u[:, None]),
        run_observer(o, y[:, None], u[:, None]),
    )
    other = in_sizes(o, {"position": 2.0, "velocity": 0.3, "target": 5.0})
    found = run_observer(other, y[:, None] / 2.0, u[:, None] / [5.0, 1.0])
    np.testing.assert_allclose(
        found[..., :2] * [2.0, 0.3], run_observer(o, y[:, None], u[:, None])[..., :2], rtol=1e-9, atol=1e-12
    )


def test_a_sample_without_its_input_starts_from_rest():
    o, (y, u) = MACHINES["start in motion"](), samples(20, faults=False)
    u[0] = np.nan
    with_it, without = (run_observer(own, y[:1, None], u[:1, None]) for own in (o, replace(o, start_in_motion=None)))
    np.testing.assert_array_equal(with_it, without)


@pytest.mark.parametrize("kind", [k for k in MACHINES if "motion" in k])
def test_a_machine_at_rest_starts_as_without(kind):
    o, (y, u) = MACHINES[kind](), samples(20, faults=False)
    y[:] = u[:, :1] = 0.3
    u[:, 1] = 0.0
    y[1:] += 1e-3 * np.random.default_rng(0).normal(size=(19, 1))
    with_it, without = (run_observer(own, y[:, None], u[:, None]) for own in (o, replace(o, start_in_motion=None)))
    np.testing.assert_array_equal(with_it, without)
    u[0, 1] = 0.1
    assert np.abs(run_observer(o, y[:, None], u[:, None]) - without).max() > 1e-4


def test_what_the_first_samples_add_is_what_makes_the_run_differ():
    o, (y, u) = moving(MACHINES["gain"]()), samples(30, faults=False)
    y, u = y[:, None], u[:, None]
    first, added = started(o, y, u)
    x, plain = run_observer(o, y, u), replace(o, start_in_motion=None)
    np.testing.assert_array_equal(x[0], first)
    for k in range(29):
        lifted = o.lifting.lift(x[k], o.parameters)
        wanted = lifted @ o.A.T + u[k] @ o.B.T + (y[k] - x[k][:, :1]) @ o.controller.D.T
        wanted = wanted[:, :3] + (added[k] if k < len(added) else 0.0)
        np.testing.assert_allclose(x[k + 1], wanted, rtol=1e-9, atol=1e-12)
    assert np.abs(run_observer(plain, y, u)[5] - x[5]).max() > 1e-3
