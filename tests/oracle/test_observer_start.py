"""Starts in motion: against the Kalman filter that does not know where it starts, against loops, and within certificates."""

from dataclasses import replace

import numpy as np
import pytest
from machines import MACHINES, moving, samples

from kros.observer import Observer, run_observer
from kros.observer.simulate import started
from kros.observer.units import in_sizes


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
        run_observer(Observer.load(tmp_path / "o.json"), y[:, None], u[:, None]), run_observer(o, y[:, None], u[:, None])
    )
    other = in_sizes(o, {"position": 2.0, "velocity": 0.3, "target": 5.0})
    found = run_observer(other, y[:, None] / 2.0, u[:, None] / [5.0, 1.0])
    np.testing.assert_allclose(found[..., :2] * [2.0, 0.3], run_observer(o, y[:, None], u[:, None])[..., :2], rtol=1e-9, atol=1e-12)


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
