"""Bounds on errors for combinations of recorded signals, against machines that run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from batches import batch_of
from contracting import DT, contracting, recordings
from frozen import as_shown

from kros.data import EpisodeBatch
from kros.observer import Observer, Seen, relift_certificate, run_observer
from kros.observer.certificate.signals import signal_bound

N = 600


def observer(functions=(), **runtime) -> Observer:
    """Corrected by a constant gain."""
    return contracting(functions, 0, seed=3, radius=0.7, lifted=0.02, **runtime)


def errors_of(o: Observer, batch: EpisodeBatch) -> np.ndarray:
    """RMS errors, (unit, state)."""
    square = np.mean((batch.states - as_shown(o, batch)) ** 2, axis=0)
    return np.sqrt([square[[u == unit for u in batch.units]].mean(axis=0) for unit in dict.fromkeys(batch.units)])


CASES = {
    "linear": ((), {}, 1.5),
    "slopes": (("0.3*sin(3*a)", "0.2*cos(2*b)"), {}, 1.5),
    "history": (("b[-2]", "0.2*sin(a[-1])"), {}, 1.5),
    "late": (("0.3*sin(3*a)",), {"delay": 2}, 1.5),
    "limits": ((), {"upper": np.array([np.inf, 0.35, np.inf])}, 20.0),
}


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("case", CASES)
def test_bounds_hold_for_every_unit_and_are_close(case: str, noise: float) -> None:
    functions, runtime, close = CASES[case]
    o, (x, u) = observer(functions, **runtime), recordings(N)
    delay = o.runtime.delay
    y = x[np.maximum(np.arange(N) - delay, 0)] + noise * np.random.default_rng(1).standard_normal(x.shape)
    batch = batch_of(x, u, DT, units=["1", "1", "2", "2", "3", "3"])
    batch = replace(batch, shown=y) if noise or delay else batch
    found = signal_bound(relift_certificate(o), o, batch)
    assert found.certified, found.reason
    errors = errors_of(o, batch)
    assert errors.shape == (3, 3)
    assert ((found.bounds >= errors) & (found.bounds <= close * errors)).all()
    assert (found.cover == found.bounds.max(axis=0)).all()


@pytest.mark.parametrize("case", ["linear", "slopes"])
def test_bounds_hold_for_combinations_of_recorded_signals(case: str) -> None:
    """A machine is driven by residuals of some units, weighed, of either sign and later, from the first error that follows."""
    o, (x, u) = observer(CASES[case][0]), recordings(N)
    found = signal_bound(relift_certificate(o), o, batch_of(x, u, DT, units=[str(i) for i in range(6)]))
    estimates = run_observer(o, x[..., :1], u)
    lift, A, B = o.lifting, o.A[:3], o.B[:3]
    omega = x[1:] - lift.lift(x[:-1]) @ A.T - u[:-1] @ B.T
    signal = np.concatenate([(x[0] - estimates[0])[None], omega])
    rng, largest = np.random.default_rng(2), np.zeros(3)
    for later in (0, 0, 0, 40, 100):
        weights = rng.dirichlet(np.full(6, 0.3), 6) * rng.choice([-1, 1], (6, 6))
        w = np.einsum("ij,kjn->kin", weights, signal)
        w = np.concatenate([np.zeros((later, 6, 3)), w])[:N]
        state = [np.concatenate([x[0, :, :1], w[0, :, 1:]], axis=-1)]
        for k in range(N - 1):
            state.append(lift.lift(state[-1]) @ A.T + u[k] @ B.T + w[k + 1])
        truth = np.array(state)
        error = truth - run_observer(o, truth[..., :1], u)
        largest = np.maximum(largest, np.sqrt(np.mean(error**2, axis=0)).max(axis=0))
    assert (largest <= found.cover).all()
    assert (largest > 0.3 * found.cover).all()


def test_recordings_may_be_beyond_limits_by_their_noise() -> None:
    x, u = recordings(N)
    batch = batch_of(x, u, DT, units=["1", "1", "2", "2", "3", "3"])
    free, limited = observer(), observer((), upper=np.array([np.inf, 0.25, np.inf]))
    bounds = [signal_bound(relift_certificate(o), o, batch) for o in (free, limited)]
    assert not bounds[1].outside
    errors = errors_of(limited, batch)
    assert ((bounds[1].bounds >= errors) & (bounds[1].bounds < 20 * errors)).all()
    beyond = np.sqrt(np.mean(np.maximum(x[..., 1] - 0.25, 0) ** 2))
    # estimates are cut off, and nothing else changes but the states that stand for the true ones
    assert (bounds[1].cover <= bounds[0].cover + 4 * beyond).all()


def test_what_leaves_the_assumptions_has_no_bound() -> None:
    x, u = recordings(N)
    batch = batch_of(x, u, DT, units=["1", "1", "2", "2", "3", "3"])
    refuses = replace(
        observer(), seen=Seen(np.array([float(np.sort(np.abs(x[..., 0]).max(axis=0))[-2]) / 1.5]), np.array([9.0]))
    )
    found = signal_bound(relift_certificate(refuses), refuses, batch)
    assert len(found.outside) == 1
    assert found.facts()["set_outside"] == list(found.outside)
    out = np.array([unit in found.outside for unit in found.units])
    assert np.isinf(found.bounds[out]).all()
    assert (found.bounds >= errors_of(refuses, batch)).all()
    assert np.isfinite(found.bounds[~out]).all()
    grows = replace(observer(), A=1.5 * observer().A)
    found = signal_bound(relift_certificate(grows), grows, batch)
    assert not found.certified
    assert found.reason
    assert set(found.percent().values()) == {None}
