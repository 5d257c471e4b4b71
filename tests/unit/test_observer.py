"""The observer as it runs: batched, single, and on disk must be one and the same."""

import numpy as np
import pytest
from random_models import random_observer

from kros.core.errors import DataError, DimensionError
from kros.lifting import Lifting
from kros.observer import Observer, SampleStatus, run_observer
from kros.synthesis import Injection

LIFTING = Lifting(("position", "velocity", "current"), ("sin(10*position + phase)",), ("phase",))


def test_estimates_have_names_and_are_arrays():
    o = random_observer(LIFTING)
    running = o.start([0.5], phase=1.2)
    estimate = running.step([0.4], [1.0, 2.0])
    assert running.states == ("position", "velocity", "current") == tuple(estimate)
    assert [estimate[name] for name in running.states] == np.asarray(estimate).tolist() == list(estimate.values())
    assert np.asarray(estimate, dtype=np.float32).dtype == np.float32
    assert repr(estimate).startswith("Estimate(position=")
    assert repr(o).startswith("<Observer: name koopman/test, states position, velocity, current")
    np.testing.assert_array_equal(estimate, o.start([0.5], {"phase": 1.2}).step([0.4], [1.0, 2.0]))
    np.asarray(estimate)[:] = 0.0  # what is done to it leaves the observer alone
    running.step([0.4], [1.0, 2.0])
    assert np.asarray(running.estimate).all()


def test_a_controller_of_the_wrong_size_is_refused():
    o = random_observer(LIFTING)
    with pytest.raises(DimensionError, match="from 1 innovations to 2 corrections of"):
        Observer("x", LIFTING, o.A, o.B, (0,), ("a", "b"), o.controller, Injection.INPUT, 0.001)
    with pytest.raises(DimensionError, match="at least one sample"):
        run_observer(o, np.zeros((5, 2, 1)), np.zeros((4, 2, 2)))


def test_samples_that_are_not_given_are_missing():
    one, other = (random_observer(LIFTING).start([0.5]) for _ in range(2))
    for running, nothing in ((one, (None, None)), (other, ([np.nan], [np.nan, np.nan]))):
        running.step([0.5], [1.0, 2.0])
        running.step(*nothing)
        assert running.status == SampleStatus.MISSING | SampleStatus.INVALID_INPUT
    np.testing.assert_array_equal(one.estimate, other.estimate)
    other.step([0.5], [0.0, 0.0])
    assert one.step([0.5], None) != other.estimate  # inputs are held, and not zero


def test_masked_measurements_are_missing_and_text_is_refused():
    o, masked = random_observer(LIFTING), np.ma.masked_array([0.4], [True])
    expected = o.start([0.5]).step([np.nan], [1.0, 2.0])
    np.testing.assert_array_equal(o.start([0.5]).step(masked, [1.0, 2.0]), expected)
    y = np.ma.masked_array(np.full((9, 2, 1), 0.5), np.arange(18).reshape(9, 2, 1) % 4 == 3)
    np.testing.assert_array_equal(o.run(y, np.ones((9, 2, 2))), o.run(y.filled(np.nan), np.ones((9, 2, 2))))
    with pytest.raises(DataError, match=r"measurements should be numbers, found \['full'\]"):
        o.start([0.5]).step(["full"], [1.0, 2.0])
    with pytest.raises(DataError, match=r"inputs should be numbers, found \[\[1.0\], \[2.0, 3.0\]\]"):
        o.start([0.5]).step([0.5], [[1.0], [2.0, 3.0]])
