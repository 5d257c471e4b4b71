"""Observers at limits: cut off is never worse, a conditioned predictor knows what the machine's controller does, and nothing changes within."""

from dataclasses import replace

import numpy as np
import pytest

from kros.core.errors import ConfigError
from kros.core.lti import gain
from kros.data import EpisodeBatch
from kros.data.population import EpisodeKey
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, relift_certificate, run_observer, signal_bound
from kros.observer.certificate.error import ReliftScales, error_system
from kros.observer.certificate.report import course, frozen_response
from kros.observer.limits import Limit, limits_of
from kros.observer.predictor.choice import filled_in
from kros.observer.predictor.driven import driven_coordinates, with_internal
from kros.observer.predictor.limited import conditioned, with_limits
from kros.observer.predictor.moments import PastMoments
from kros.plants import DcMotorPopulation
from kros.synthesis import Injection

BACK, LEAK, LIMIT = (
    0.1,
    0.995,
    0.4,
)  # of the controller: share of the excess taken off its integrator, its leak, the current's limit


def machine(u, limit=LIMIT, noise=0.0, seed=0):
    """PI control of a first-order plant: e = u - y, raw+ = m + 0.5 e, i+ = clip(raw+), m+ = leak m + 0.02 e + back (i - raw), y+ = 0.98 y + 0.1 i."""
    y, i, raw, m = (np.zeros(u.shape[1]) for _ in range(4))
    found = np.empty((*u.shape, 2))
    for k in range(len(u)):
        found[k] = np.stack([y, i], axis=-1)
        e = u[k] - y
        y, raw, m = 0.98 * y + 0.1 * i, m + 0.5 * e, LEAK * m + 0.02 * e + BACK * (i - raw)
        i = np.clip(raw, -limit, limit)
    return found + noise * np.random.default_rng(seed).normal(size=found.shape) * [0, 1]


def recorded(seed=0, size=3.0, limit=LIMIT, batch=4, n=1500):
    rng = np.random.default_rng(seed)
    u = np.repeat(size * rng.uniform(-1, 1, (n // 100, batch)), 100, axis=0)
    states = machine(u, limit)
    keys = tuple(EpisodeKey(str(k), "c", "0") for k in range(batch))
    return EpisodeBatch(keys, np.full(batch, n), states, u[..., None], 1e-3)


@pytest.fixture(scope="module")
def predictor():
    """The machine within its limits, with the integrator as internal state; exact."""
    lifting = Lifting(("y", "current", "memory_1"))
    A = np.array([[0.98, 0.1, 0.0], [-0.5, 0.0, 1.0], [-0.02, 0.0, LEAK]])
    B = np.array([[0.0], [0.5], [0.02]])
    return Observer(
        "p", lifting, A, B, (0,), ("u",), gain(A[:, :1], 1e-3), Injection.STATE, 1e-3, replaces=True, internal=1
    )


def errors(observer, batch):
    return run_observer(observer, batch.states[..., :1], batch.inputs)[..., :2] - batch.states


def test_without_limits_the_predictor_winds_up_and_cut_off_it_is_never_worse(predictor):
    batch = recorded()
    limited = with_limits(predictor, [-np.inf, -LIMIT], [np.inf, LIMIT])
    cut = replace(
        predictor, runtime=Runtime(lower=[-np.inf, -LIMIT, -np.inf], upper=[np.inf, LIMIT, np.inf], relift=False)
    )
    free, ours, plain = errors(predictor, batch), errors(limited, batch), errors(cut, batch)
    assert np.abs(free[..., 1]).max() > 5 * LIMIT
    assert np.all(np.abs(ours[..., 1]) <= np.abs(free[..., 1]) + 1e-12)
    np.testing.assert_allclose(ours, plain, atol=1e-12)  # with no gain, the internal states run on: the same estimates


def test_conditioning_finds_what_the_controller_does_at_its_limit(predictor):
    limited, batch = with_limits(predictor, [-np.inf, -LIMIT], [np.inf, LIMIT]), recorded(size=1.0, batch=2)
    found = conditioned(limited, batch, iterations=40)
    before, after = (np.sqrt(np.mean(errors(o, recorded(seed=5)) ** 2, axis=(0, 1))) for o in (limited, found))
    assert np.all(after < 1e-6 * before)
    memory, current, raw = 2, 1, 3
    np.testing.assert_allclose(
        found.A[[memory, raw], current], [BACK, 0.0], atol=1e-6
    )  # the machine's own back-calculation


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_within_the_limits_nothing_changes(predictor, noise):
    found = conditioned(with_limits(predictor, [-np.inf, -LIMIT], [np.inf, LIMIT]), recorded(), iterations=3)
    quiet = recorded(seed=1, size=0.1)
    assert np.abs(quiet.states[..., 1]).max() < 0.9 * LIMIT
    y = quiet.states[..., :1] + noise * 0.1 * np.random.default_rng(3).normal(size=quiet.states[..., :1].shape)
    np.testing.assert_allclose(
        run_observer(found, y, quiet.inputs)[..., :2], run_observer(predictor, y, quiet.inputs)[..., :2], atol=1e-11
    )


def test_conditioned_predictors_run_in_coordinates_and_sample_by_sample_alike_and_are_certified(predictor):
    batch = recorded(batch=2)
    found = conditioned(with_limits(predictor, [-np.inf, -LIMIT], [np.inf, LIMIT]), batch, iterations=4)
    turned = driven_coordinates(found, batch, [1.0, LIMIT])
    estimates = run_observer(found, batch.states[..., :1], batch.inputs)[..., :2]
    np.testing.assert_allclose(run_observer(turned, batch.states[..., :1], batch.inputs)[..., :2], estimates, atol=1e-9)
    driven = with_internal(turned, batch.states, batch.inputs)
    assert np.abs(driven[..., 2:]).max() < 100 * np.sqrt(np.mean(driven[..., 2:] ** 2))
    running = turned.start(batch.states[0, 0, :1])
    by_hand = [
        np.asarray(running.step(y, u))[:2] for y, u in zip(batch.states[:-1, 0, :1], batch.inputs[:-1, 0], strict=True)
    ]
    np.testing.assert_allclose(by_hand, estimates[1:, 0], atol=1e-9)
    certificate = relift_certificate(turned)
    assert certificate.certified
    assert any("limits of current" in channel for channel in certificate.channels)


def test_limits_are_written_in_many_ways_and_refused_where_they_cannot_be():
    assert Limit.of(0.35, "x") == Limit.of([-0.35, 0.35], "x") == Limit.of({"lower": -0.35, "upper": 0.35}, "x")
    assert limits_of({"current": Limit.of(False, "x")}, {}, ("y", "current")) == {}
    for wrong in ([0.3, -0.3], True, "much", [1, 2, 3], {"most": 1.0}, 0.0):
        with pytest.raises(ConfigError):
            Limit.of(wrong, "Study, limits.current")
    with pytest.raises(ConfigError, match="torque should be among the recorded states"):
        limits_of({"torque": Limit.of(1.0, "x")}, {}, ("y", "current"))


def test_recorded_signals_within_the_limits_have_the_bound_of_an_observer_without(predictor):
    quiet, loud = recorded(seed=1, size=0.1), recorded()
    assert np.abs(quiet.states[..., 1]).max() < 0.9 * LIMIT
    found = conditioned(with_limits(predictor, [-np.inf, -LIMIT], [np.inf, LIMIT]), loud, iterations=4)
    free = replace(found, runtime=Runtime())
    with_them, without = (signal_bound(relift_certificate(o), o, quiet) for o in (found, free))
    assert with_them.within
    assert with_them.facts((0,))["set_within_limits"]
    np.testing.assert_allclose(with_them.cover, without.cover, rtol=1e-9)


def test_what_limits_cut_off_is_a_residual_of_the_observer_without_them(predictor):
    batch = recorded(batch=3, n=1000)
    batch = replace(
        batch, states=batch.states + 0.02 * np.random.default_rng(1).normal(size=batch.states.shape) * [0, 1]
    )
    held = np.clip(batch.states, [-np.inf, -LIMIT], [np.inf, LIMIT])
    batch = replace(batch, states=held)
    limited = with_limits(predictor, [-np.inf, -LIMIT], [np.inf, LIMIT])
    A = limited.A.copy()
    A[2:, 1], A[2:, 3] = A[2:, 1] + BACK / 2, A[2:, 3] - BACK / 2  # half of what the controller does
    observer = replace(limited, A=A)
    free, seen = replace(observer, runtime=Runtime()), course(observer, batch, cut=True)
    system = error_system(free, ReliftScales.ones(free))
    z, _ = frozen_response(system, seen.omega, seen.first)
    assert np.abs(seen.omega - course(observer, batch).omega).max() > LIMIT  # they do cut off
    np.testing.assert_allclose(
        z[..., :2], (batch.states - run_observer(observer, held[..., :1], batch.inputs)[..., :2]), atol=1e-9
    )
    bound = signal_bound(relift_certificate(observer), observer, batch)
    assert bound.facts((0,))["set_within_limits"] is False
    assert np.all(bound.ratios[:, 1] >= 1)
    assert np.all(bound.ratios[:, 1] <= 1.3)
    assert np.all(bound.cover >= bound.bounds.max(axis=0) * (1 - 1e-9))


def test_the_basis_has_states_at_no_sample():
    """A limit that was found in other episodes may never be reached in those that a predictor is made from."""
    motors = DcMotorPopulation(n_units=2, n_episodes=1, seconds=2.0, seed=3).simulate().population
    batch = EpisodeBatch.read(motors, motors.keys())
    past = PastMoments.of(Lifting(motors.states), (0,), batch)
    far = np.full(len(motors.states), 1e9)
    _, fill = filled_in(past, batch, -far, far)
    np.testing.assert_array_equal(fill(batch).states, batch.states)
    assert past.states_at(past.channels(batch)[:, 0], np.zeros(0, int)).shape == (0, past.gram.shape[1])
