"""Samples that are missing, wrong or impossible: what an observer makes of them, and that it gets over them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from batches import track_parameter

from kros.core.errors import ConfigError, DataError, DimensionError
from kros.core.lti import StateSpace, gain
from kros.data.population import EpisodeKey
from kros.design.baselines import Baseline
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, SampleStatus, Seen, relift_certificate, run_observer
from kros.observer.baselines.difference import FilteredDifference
from kros.observer.baselines.extended_kalman import ExtendedKalman, start_covariance
from kros.observer.certificate.error import error_system
from kros.observer.screen import screened
from kros.synthesis import Injection

DT, N, AT = 0.001, 2700, 200
DRIVE = Lifting(("position", "velocity"), ("sin(10*position + phase)",), ("phase",))
LATE = Lifting(("position", "velocity"), ("position[-2]*velocity", "tanh(velocity)"), (), ("a", "b"), ("velocity*a",))
SEEN = Seen(np.array([2.0]), np.array([1.0, 1.0]))


def observer(kind="lifted", seen=SEEN, runtime=None):
    """Stable machines whose slowest time constant is below 400 samples."""
    lifting = {"lifted": DRIVE, "filter": DRIVE, "linear": Lifting(("position", "velocity")), "delays": LATE}[kind]
    n, nl = 2, lifting.n_lifted
    A = np.zeros((nl, nl))
    A[:n, :n] = [[0.999, 0.01], [-0.01, 0.99]]
    A[1, n:] = 0.005
    B = np.zeros((nl, 2 + len(lifting.input_functions)))
    B[1] = 0.01
    D = np.zeros((nl, 1))
    D[:n] = [[0.1], [0.2]]
    K = gain(D, DT)
    if kind == "filter":
        C = np.zeros((nl, 2))
        C[:n] = [[0.01, 0.0], [0.02, -0.01]]
        K = StateSpace(np.diag([0.99, 0.9]), np.array([[0.1], [1.0]]), C, D, DT)
    parameters = {"phase": 0.3} if lifting is DRIVE else {}
    return Observer(
        kind, lifting, A, B, (0,), ("a", "b"), K, Injection.STATE, DT, parameters, runtime or Runtime(), seen
    )


@cache
def machine(n_samples):
    """What the lifted observer's model does, with another phase: position, and inputs that swing."""
    t, o = np.arange(n_samples) * DT, observer()
    u = np.stack([np.sin(7 * t + 1), np.cos(3 * t)], axis=-1)[:, None]
    x = np.zeros((n_samples, 1, 2))
    x[0] = [0.5, 0.1]
    for k in range(n_samples - 1):
        x[k + 1] = DRIVE.lift(x[k], {"phase": 0.5}) @ o.A[:2].T + u[k] @ o.B[:2].T
    return x[..., :1], u


def recordings(n_samples=N):
    y, u = machine(n_samples)
    return y.copy(), u.copy()


def single(o, y, u, parameters=None):
    running = o.start(y[0, 0], parameters)
    found, status = [running.estimate], []
    for k in range(len(y)):
        found.append(running.step(y[k, 0], u[k, 0]))
        status.append(running.status)
    return np.array(found[:-1]), status


def _at(which, rows, value, channel=slice(None)):
    def change(y, u):
        (y if which == "y" else u)[rows, 0, channel] = value

    return change


def _both(y, u):
    y[:7], u[:12], u[AT : AT + 50, 0, 1], y[AT + 40 : AT + 60] = -1e9, np.nan, np.inf, np.nan


FAULTS = {
    "no number on an input": _at("u", AT, np.nan, 0),
    "an infinite input": _at("u", AT, -np.inf),
    "inputs missing for a while": _at("u", slice(AT, AT + 200), np.nan),
    "an input spike": _at("u", AT, 1e9, 1),
    "many input spikes": _at("u", slice(AT, AT + 100, 2), -1e9),
    "no measurement": _at("y", AT, np.nan),
    "an infinite measurement": _at("y", AT, np.inf),
    "measurements missing for a while": _at("y", slice(AT, AT + 200), np.nan),
    "a spike": _at("y", AT, 1e9),
    "spikes for a while": _at("y", slice(AT, AT + 100), -1e9),
    "spikes near the largest number": _at("y", AT, 1.7e308),
    "the first input": _at("u", 0, np.nan),
    "the first inputs": _at("u", slice(0, 30), 1e9, 0),
    "the first measurement": _at("y", 0, np.nan),
    "the first measurements": _at("y", slice(0, 30), 1e9),
    "everything": _both,
}
LAST = AT + 200


def spoiled(fault):
    y, u = recordings()
    bad_y, bad_u = y.copy(), u.copy()
    FAULTS[fault](bad_y, bad_u)
    return y, u, bad_y, bad_u


def together():
    """Clean recordings and all faults, side by side."""
    given = [recordings(), *(spoiled(fault)[2:] for fault in FAULTS)]
    return np.concatenate([y for y, _ in given], axis=1), np.concatenate([u for _, u in given], axis=1)


def require_forgotten(found):
    assert np.isfinite(found).all()
    clean, spoilt = found[:, :1], found[:, 1:]
    away = np.abs(spoilt - clean) / np.sqrt(np.mean(clean**2, axis=0))
    assert (away.max(axis=(0, 2)) > 1e-9).all()  # every fault is seen; of one lost input little
    worst = dict(zip(FAULTS, away[LAST + 2000 :].max(axis=(0, 2)), strict=True))
    assert not {fault: share for fault, share in worst.items() if not share < 0.01}


@pytest.mark.parametrize("kind", ["lifted", "filter", "linear", "delays"])
def test_a_fault_is_forgotten(kind):
    """Within one percent of the estimate's RMS after 2000 good samples; the slowest time constant is a fifth of that at most."""
    o = observer(kind)
    slowest = np.abs(
        np.linalg.eigvals(error_system(o, box={"a": (-1, 1), "position": (-2, 2), "velocity": (-2, 2)}).A)
    ).max()
    assert -1 / np.log(slowest) < 400
    require_forgotten(run_observer(o, *together()))


def test_the_phase_locked_loop_forgets_too():
    y, u = together()
    found = track_parameter(observer("lifted"), y, u, {"phase": 0.1}, settle_s=0.3)
    require_forgotten(found.estimates)
    assert np.all(np.abs(found.followed[:, 1:] - found.followed[:, :1])[LAST + 2000 :] < 0.01)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize(("kind", "delay"), [("lifted", 0), ("delays", 3)])
def test_one_machine_and_a_batch_judge_alike(kind, delay, fault):
    limits = Runtime(delay, lower=np.array([-0.7, -np.inf]), upper=np.array([0.7, 5.0]))
    y, u, bad_y, bad_u = (x[AT - 40 : AT + 40] if not fault.startswith("the first") else x[:40] for x in spoiled(fault))
    for o in (observer(kind, runtime=limits), observer(kind, runtime=Runtime(delay))):
        found, status = single(o, bad_y, bad_u)
        both = run_observer(o, np.concatenate([y, bad_y], axis=1), np.concatenate([u, bad_u], axis=1))
        np.testing.assert_allclose(both[:, 1], found, rtol=1e-9, atol=1e-12)
        # the other machine of the batch does not notice
        np.testing.assert_allclose(both[:, 0], run_observer(o, y, u)[:, 0], rtol=1e-9, atol=1e-12)
        own = screened(o, bad_y, bad_u).status[:, 0]
        assert all(SampleStatus(int(b)) in s for b, s in zip(own, status, strict=True))


def test_every_kind_of_fault_has_its_bit():
    o = observer()
    good = ([0.1], [0.2, 0.3])
    running = o.start(good[0])
    cases = {
        SampleStatus.GOOD: good,
        SampleStatus.MISSING: ([np.nan], good[1]),
        SampleStatus.MISSING | SampleStatus.INVALID_INPUT: ([-np.inf], [np.nan, 0.0]),
        SampleStatus.INVALID_INPUT: (good[0], [0.0, np.inf]),
        SampleStatus.LIMIT: ([1e9], good[1]),
        SampleStatus.LIMIT | SampleStatus.INVALID_INPUT: (good[0], [1.6, np.nan]),
    }
    for expected, sample in cases.items():
        running.step(*sample)
        assert running.status == expected
        running.step(*good)
        assert running.status == SampleStatus.GOOD
    assert [
        b.value
        for b in (SampleStatus.MISSING, SampleStatus.INVALID_INPUT, SampleStatus.LIMIT, SampleStatus.UNCERTIFIED)
    ] == [
        1,
        2,
        4,
        8,
    ]
    assert o.start([np.nan]).status == SampleStatus.MISSING


def test_what_lies_within_one_and_a_half_times_the_range_is_believed():
    o = observer()
    y, u = recordings(50)
    y[20], u[30, 0, 1] = 2.99, -1.49
    assert not screened(o, y, u).status.any()
    np.testing.assert_array_equal(run_observer(o, y, u), run_observer(replace(o, seen=None), y, u))
    y[20] = 3.01
    missing = y.copy()
    missing[20] = np.nan
    np.testing.assert_array_equal(run_observer(o, y, u), run_observer(o, missing, u))
    assert np.flatnonzero(screened(o, y, u).status).tolist() == [20]
    assert not screened(replace(o, seen=None), 1e6 * y, u).status.any()
    # nothing is known of an input that never was anything but zero
    zero = replace(o, seen=Seen(np.array([2.0]), np.array([0.0, 1.0])))
    assert not screened(zero, np.clip(y, -1, 1), u).status.any()


def test_a_declared_limit_takes_the_place_of_the_range():
    o = observer(runtime=Runtime(lower=np.array([-3.0, -9.0]), upper=np.array([2.0, 9.0])))
    y, u = recordings(50)
    y[10:12] = 2.5
    np.testing.assert_array_equal(run_observer(o, y, u), run_observer(o, np.clip(y, -3, 2), u))
    assert np.flatnonzero(screened(o, y, u).status == SampleStatus.LIMIT).tolist() == [10, 11]
    y[10:12] = 4.6  # beyond 1.5 times the declared range
    gone = y.copy()
    gone[10:12] = np.nan
    np.testing.assert_array_equal(run_observer(o, y, u), run_observer(o, gone, u))


def test_an_estimate_at_its_limit_says_so_and_the_observer_goes_on_without():
    o = observer(runtime=Runtime(upper=np.array([np.inf, 0.001])))
    running, free = o.start([0.0]), replace(o, runtime=Runtime()).start([0.0])
    for y in (0.5, 0.4, 0.3):
        estimate, unlimited = (np.asarray(one.step([y], [1.0, 1.0])) for one in (running, free))
        assert running.status == SampleStatus.LIMIT
        np.testing.assert_array_equal(estimate, [unlimited[0], min(unlimited[1], 0.001)])


def test_an_input_goes_on_with_its_slope_is_held_then_and_zero_before_the_first():
    o = observer("linear")
    y, u = recordings(40)
    bad, held = u.copy(), u.copy()
    bad[20:28, 0, 0] = np.nan
    bad[30, 0, 0], bad[32, 0, 0] = np.nan, np.nan
    held[20:28, 0, 0] = u[19, 0, 0] + (u[19, 0, 0] - u[18, 0, 0]) * np.minimum(np.arange(1, 9), 5)
    held[30, 0, 0] = 2 * u[29, 0, 0] - u[28, 0, 0]
    held[32, 0, 0] = u[31, 0, 0] + (u[31, 0, 0] - u[29, 0, 0]) / 2
    np.testing.assert_allclose(screened(o, y, bad).u, held, rtol=1e-12)
    switched = np.where(np.arange(40)[:, None, None] < 19, 0.0, 1.0) + 0 * u
    switched[20:, 0, 0] = np.nan
    assert screened(replace(o, seen=Seen(np.ones(1), np.ones(u.shape[-1]))), y, switched).u.max() == 1.5
    blocks = screened(o, y[:22], bad[:22])
    np.testing.assert_allclose(screened(o, y[22:], bad[22:], blocks.held).u, held[22:], rtol=1e-12)
    nothing = np.full_like(u, np.nan)
    np.testing.assert_array_equal(run_observer(o, y, nothing), run_observer(o, y, np.zeros_like(u)))
    late = run_observer(o, y[10:], u[10:])
    bad = u.copy()
    bad[:10] = np.nan
    # it starts where it first has everything
    np.testing.assert_allclose(run_observer(o, y, bad)[11:], late[1:], rtol=1e-12)


def test_reset_leaves_nothing_of_the_past():
    o = observer("filter", runtime=Runtime(2))
    y, u = recordings(60)
    running = o.start(y[0, 0])
    for k in range(30):
        running.step(y[k, 0] if k % 3 else [np.nan], [np.nan, 1e9])
    running.reset(y[0, 0])
    assert running.status == SampleStatus.GOOD
    again = [running.step(y[k, 0], u[k, 0]) for k in range(30)]
    fresh = o.start(y[0, 0])
    np.testing.assert_array_equal(again, [fresh.step(y[k, 0], u[k, 0]) for k in range(30)])


def test_what_does_not_fit_is_named():
    o, (y, u) = observer(), recordings(5)
    running = o.start([0.0])
    for make in (
        lambda: o.start([0.0], {"phse": 1.0}),
        lambda: run_observer(o, y, u, {"phse": 1.0}),
        lambda: setattr(running, "parameters", {"phse": 1.0}),
    ):
        with pytest.raises(ConfigError, match="'phse' is unknown; its lifting has phase"):
            make()
    bare = replace(o, parameters={})
    for make in (lambda: bare.start([0.0]), lambda: run_observer(bare, y, u), lambda: track_parameter(bare, y, u)):
        with pytest.raises(ConfigError, match="'phase' is missing"):
            make()
    with pytest.raises(ConfigError, match="'phase' is not finite"):
        o.start([0.0], {"phase": np.nan})
    with pytest.raises(DimensionError, match=r"'phase' should have shape \(1,\), found \(3,\)"):
        run_observer(o, y, u, {"phase": np.zeros(3)})
    with pytest.raises(DimensionError, match=r"1 measurements position, shape \(1,\), found shape \(2,\)"):
        running.step([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(DimensionError, match=r"2 inputs a, b, shape \(2,\), found shape \(1,\)"):
        running.step([0.0], 0.0)
    with pytest.raises(DimensionError, match="expected 1 measurements"):
        run_observer(o, np.zeros((5, 1, 2)), u)
    with pytest.raises(DimensionError, match="the inputs"):
        run_observer(o, y, u[..., :1])
    with pytest.raises(DimensionError, match="at least one sample"):
        run_observer(o, y[:0], u[:0])
    with pytest.raises(DimensionError, match="sizes seen in training"):
        replace(o, seen=Seen([1.0, 2.0], [1.0, 1.0]))
    with pytest.raises(DataError, match="finite and not negative"):
        Seen([np.nan], [1.0])


DECLARED = {
    "measurements arrive 2 samples late": Runtime(delay=2),
    "the true position stays within the limits of the estimate": Runtime(lower=np.array([-1.0, -np.inf])),
}


@pytest.mark.parametrize("what", DECLARED)
def test_certificates_say_what_they_assume_of_a_delay_and_limits(what):
    plain = relift_certificate(observer())
    assert "every measurement arrives" in plain.assumptions
    assert "no measurement and no input is refused as implausible" in plain.assumptions
    found = relift_certificate(observer(runtime=DECLARED[what]))
    assert found.certified
    assert any(what in text for text in found.assumptions)
    assert not any(what in text for text in plain.assumptions)
    free = relift_certificate(observer(runtime=Runtime(upper=np.full(2, np.inf))))
    assert (free.gain, free.assumptions) == (plain.gain, plain.assumptions)  # no limit is none


def test_baselines_judge_samples_as_observers_do():
    y, u = together()
    keys = tuple(EpisodeKey("a", "c", str(i)) for i in range(y.shape[1]))
    o = observer()
    extended = ExtendedKalman(
        DRIVE,
        o.A,
        o.B,
        (0,),
        1e-4 * np.eye(2),
        np.array([[1e-4]]),
        start_covariance(np.ones(2), np.array([[1e-4]]), (0,)),
        {"phase": 0.3},
    )
    for estimator, states in ((extended, (0, 1)), (FilteredDifference(2, ((0, 1),), 20.0, DT), (1,))):
        baseline = Baseline({"": estimator}, (0,), states, {}, seen=SEEN)
        found = baseline.estimate(keys, y, u, {})[..., list(states)]
        away = np.abs(found[:, 1:] - found[:, :1]) / np.sqrt(np.mean(found[:, :1] ** 2, axis=0))
        assert np.all(away[LAST + 2000 :] < 0.01)
