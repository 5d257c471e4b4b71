"""Observers with memory against systems whose memory is known, and against the Kalman predictor."""

import numpy as np
import pytest
from batches import batch_of

from kros.core.errors import DataError, DimensionError
from kros.lifting import Lifting
from kros.observer import (
    Observer,
    PastMoments,
    identify_predictor,
    relift_certificate,
    run_observer,
)
from kros.observer.predictor.build import embedded
from kros.observer.predictor.tuning import tune_predictor
from kros.synthesis import Injection, kalman
from kros.synthesis.residual_shaped.shaping_filter import Basis

DT = 0.01
LIFTING = Lifting(("p", "c"), ("sin(5*p + phase)",), ("phase",))
NAMES, UNITS = ("target", "push"), list("aabbcc")


def controlled(n_samples=2500, batch=6, seed=0, home=0.0):
    """The hidden state is the command of a controller with an integrator: it is known from the past of tracking errors, not from p.

    With `home` machines rest in places of that standard deviation at first: M is exact.
    """
    rng = np.random.default_rng(seed)
    target = np.cumsum(0.01 * rng.normal(size=(n_samples, batch)), axis=0)
    push, phase = rng.normal(size=(n_samples, batch)), rng.uniform(-3, 3, batch)
    x, integral = np.zeros((n_samples, batch, 2)), np.zeros(batch)
    x[0, :, 0] = home * rng.normal(size=batch)
    target += x[0, :, 0] - target[0]
    for k in range(n_samples - 1):
        p, c = x[k].T
        error = target[k] - p
        integral = 0.99 * integral + error
        wave = np.sin(5 * p + phase)
        x[k + 1, :, 0] = p + 0.1 * c + 0.01 * wave + 0.003 * rng.normal(size=batch)
        x[k + 1, :, 1] = 0.5 * c + 0.8 * error + 0.02 * integral + 0.1 * push[k] + 0.05 * wave
    return x, np.stack([target, push], axis=-1), {"phase": phase}


def size(values):
    return np.sqrt(np.mean(values[400:] ** 2))


@pytest.fixture(scope="module")
def made():
    x, u, phase = controlled()
    past = PastMoments.of(LIFTING, (0,), batch_of(x, u, DT, phase, units=UNITS), Basis(20))
    return past, x, u, phase


def test_what_runs_is_an_observer_like_any_other(made, tmp_path):
    past, x, u, phase = made
    observer = embedded("o", past, past.model(4), NAMES, batch_of(x, u, DT, phase, units=UNITS))
    assert observer.lifting.states == ("p", "c", "memory_1", "memory_2", "memory_3")
    assert relift_certificate(observer, mismatch=False).certified
    observer.save(tmp_path / "o.json")
    again = Observer.load(tmp_path / "o.json")
    running, expected = (
        again.start(x[0, 0, :1], {"phase": phase["phase"][0]}),
        observer.run(x[:50, :1, :1], u[:50, :1], {"phase": phase["phase"][:1]}),
    )
    for k in range(49):
        np.testing.assert_allclose(running.step(x[k, 0, :1], u[k, 0]), expected[k + 1, 0], rtol=1e-9, atol=1e-9)


def test_a_linear_system_gets_the_kalman_predictor():
    rng = np.random.default_rng(3)
    F, G, Q = np.array([[1.0, 0.1], [-0.3, 0.8]]), np.array([[0.0], [1.0]]), np.diag([1e-3, 4e-2])
    x, u = np.zeros((4000, 6, 2)), rng.normal(size=(4000, 6, 1))
    for k in range(3999):
        x[k + 1] = x[k] @ F.T + u[k] @ G.T + rng.normal(size=(6, 2)) * np.sqrt(np.diag(Q))
    plain = Lifting(("x", "v"))
    past = PastMoments.of(plain, (0,), batch_of(x, u, DT), Basis(30))
    found = embedded("o", past, past.model(4), ("u",), batch_of(x, u, DT))
    best = kalman(F, np.eye(1, 2), Q, np.array([[1e-15]]), DT)
    ideal = Observer("k", plain, F, G, (0,), ("u",), best.controller, Injection.STATE, DT)
    errors = [size((run_observer(o, x[..., :1], u)[..., :2] - x)[..., 1]) for o in (found, ideal)]
    assert errors[0] == pytest.approx(errors[1], rel=0.02)


def test_what_cannot_be_done_is_refused(made):
    past, x, u, phase = made
    with pytest.raises(DimensionError, match="alone"):
        PastMoments.of(Lifting(("p", "c"), ("sin(c)",)), (0,), batch_of(x, u, DT))
    with pytest.raises(DataError, match="not measured"):
        PastMoments.of(LIFTING, (0, 1), batch_of(x, u, DT, phase))
    with pytest.raises(DataError, match="no unit is left"):
        past.model(3, without=["a", "b", "c"])
    with pytest.raises(DimensionError, match="at least as many"):
        past.model(0)


def test_it_starts_at_rest(made):
    past, x, u, phase = made
    observer = embedded("o", past, past.model(4), NAMES, batch_of(x, u, DT, phase, units=UNITS))
    y = np.full((5, 6, 1), 0.7)
    u = np.concatenate([y / past.static[0, 0], np.zeros_like(y)], axis=-1)  # target and measurement in balance, no push
    estimates = run_observer(observer, y, u, phase)
    np.testing.assert_allclose(estimates[1, :, 1:], estimates[0, :, 1:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        observer.start([0.7], {"phase": phase["phase"][2]}).step([0.7], u[0, 2]), estimates[1, 2], rtol=1e-12
    )


def test_tuning_finds_the_controller_of_which_the_hidden_state_is_the_command():
    x, u, phase = controlled(home=3.0)
    past = PastMoments.of(LIFTING, (0,), batch_of(x, u, DT, phase, units=UNITS), Basis(20))
    (F, _, _), criterion = tune_predictor(
        past.model(2), past, batch_of(x, u, DT, phase, units=UNITS), iterations=40, least_gain=1e-6
    )
    assert list(criterion) == sorted(criterion, reverse=True)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(F).real), [0.5, 0.99], atol=2e-3)


def test_the_whole_way_gives_an_observer_that_is_certified():
    x, u, phase = controlled(home=3.0)
    observer = identify_predictor(
        "o", LIFTING, (0,), NAMES, batch_of(x, u, DT, phase, units=UNITS), internal=1, deviation=0.0
    )
    fresh, v, other = controlled(seed=1, home=3.0)
    missed = (observer.run(fresh[..., :1], v, other)[..., :2] - fresh)[..., 1]
    assert size(missed) < 0.02 * size(
        fresh[..., 1]
    )  # one memory is all there is to know: what is left are starts, forgotten as 0.99^k
    assert relift_certificate(observer, mismatch=False).certified


def test_a_model_that_is_not_stable_is_refused():
    x, u, phase = controlled(n_samples=700)
    past = PastMoments.of(LIFTING, (0,), batch_of(x, u, DT, phase, units=UNITS), Basis(20))
    F, G, H = past.model(2)
    with pytest.raises(DataError, match="not stable"):
        tune_predictor(
            (1.5 * F / np.abs(np.linalg.eigvals(F)).max(), G, H), past, batch_of(x, u, DT, phase, units=UNITS)
        )
