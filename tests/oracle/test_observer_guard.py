"""The guard against a slow observer written out, in a batch, sample by sample and in C."""

from itertools import pairwise

import numpy as np
import pytest
from batches import run_with_status

from kros.core import StateSpace
from kros.export import CompiledObserver, export_c
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, SampleStatus
from kros.observer.filter_bank import FilterBank
from kros.observer.runtime import Guard
from kros.observer.simulate import Course
from kros.synthesis import Injection

DT, SETTLE, BOUND = 0.01, 4, np.array([3.0, 5.0])
A, B = np.array([[1.1, 0.1], [0.3, 1.2]]), np.array([[0.0], [0.1]])  # grows where nothing corrects it
K = StateSpace([[0.3]], [[0.1]], [[0.2], [0.1]], [[1.1], [1.4]], DT)


def unstable(**changes):
    guard = Guard(-BOUND, BOUND, np.array([2.0]), SETTLE)
    return Observer(
        "o",
        Lifting(("x", "v")),
        A,
        B,
        (0,),
        ("u",),
        K,
        Injection.STATE,
        DT,
        guard=changes.pop("guard", guard),
        **changes,
    )


def recordings(n_samples=400, batch=6, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n_samples, batch, 1))
    y = np.sin(0.1 * np.arange(n_samples))[:, None, None] + 0.1 * rng.normal(size=(n_samples, batch, 1))
    y[rng.random(y.shape) < np.linspace(0, 0.9, batch)[:, None]] = np.nan
    return y, u


def written_out(y, u, bound=BOUND, largest=2.0):
    """One machine: estimates and whether it waits or has not settled."""
    x, c, waiting, left, found = np.array([np.nan_to_num(y[0]), 0.0]), 0.0, False, 0, []
    for k in range(len(y)):
        before = x
        if waiting and np.isfinite(y[k]):
            x, c, waiting = np.array([y[k], 0.0]), 0.0, False
        if k == 0 or (not np.isfinite(y[:k]).any() and np.isfinite(y[k])):
            x, c = np.array([np.nan_to_num(y[k]), 0.0]), 0.0
        if not waiting:
            nu = y[k] - x[0] if np.isfinite(y[k]) else 0.0
            ahead = A @ x + B[:, 0] * u[k] + K.C[:, 0] * c + K.D[:, 0] * nu
            filtered = 0.3 * c + 0.1 * nu
            waiting = not (np.all(np.abs(ahead) <= bound) and abs(filtered) <= largest)
            x, c = (x, c) if waiting else (ahead, filtered)
        found.append((before, waiting or left > 0))
        left = SETTLE if waiting else max(left - 1, 0)
    return np.array([x for x, _ in found]), np.array([flag for _, flag in found])


def test_lost_samples_of_every_share_are_survived_as_written_out():
    y, u = recordings()
    x, status = run_with_status(unstable(), y, u)
    assert np.all(np.abs(x) <= BOUND)
    for i in range(y.shape[1]):
        expected, restarted = written_out(y[:, i, 0], u[:, i, 0])
        np.testing.assert_allclose(x[:, i], expected, atol=1e-9)
        np.testing.assert_array_equal((status[:, i] & SampleStatus.RESTARTED) > 0, restarted)
    assert 0.1 < np.mean(status & SampleStatus.RESTARTED > 0) < 0.9


@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("guard", [True, False])
def test_a_batch_one_machine_and_c_agree(delay, guard, tmp_path):
    o = unstable(runtime=Runtime(delay=delay), **({} if guard else {"guard": None}))
    y, u = recordings()
    if not guard:
        y[50:] = np.nan  # grows without bounds until it is no number
        y[-20:] = 0.5
        y, u = (np.repeat(a[:, ::3], 4, axis=0) for a in (y, u))
    batch, status = run_with_status(o, y, u)
    assert np.isfinite(batch).all()
    compiled = CompiledObserver.build(export_c(o, tmp_path / "c", "o"))
    for i in range(0, y.shape[1], 4):
        running = o.start(y[0, i])
        found = [
            (np.asarray(running.step(*sample)), int(running.status)) for sample in zip(y[:, i], u[:, i], strict=True)
        ]
        ahead = np.array([x for x, _ in found])
        np.testing.assert_allclose(ahead[:-1], batch[1:, i], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(np.array([s for _, s in found]) & 16, status[:, i] & 16)
        in_c, status_c = compiled.run(y[:, i], u[:, i])
        np.testing.assert_allclose(in_c, ahead, rtol=1e-6, atol=1e-9)
        np.testing.assert_array_equal(status_c & 16, status[:, i] & 16)


@pytest.mark.parametrize("loops", [True, False])
@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("kind", ["guard", "history", "bank"])
def test_a_recording_in_blocks_is_run_as_a_whole(kind, delay, loops, monkeypatch):
    """Gaps across the borders of blocks, restarts, delays, lost inputs, past values, filter banks."""
    y, u = recordings(seed=4)
    u[180:192], u[146:152] = np.nan, np.nan  # held, then a new start; the second time over a border
    y[60:75], y[305:330] = np.nan, np.nan
    y[100:170], y[340:] = np.sin(np.arange(70))[:, None, None], 0.5  # where nothing is missing
    if kind == "history":
        lifting = Lifting(("x", "v"), ("x[-2]*v", "tanh(v)"), (), ("u",), ("v*u[-1]",))
        A_l, B_l = (
            np.vstack([np.hstack([0.9 * np.eye(2), [[0.1, 0.05], [0.02, 0.1]]]), np.zeros((2, 4))]),
            np.ones((4, 2)),
        )
        K_l = StateSpace(K.A, K.B, np.vstack([K.C, [[0.0], [0.0]]]), np.vstack([K.D, [[0.0], [0.0]]]), DT)
        o = Observer("h", lifting, A_l, 0.01 * B_l, (0,), ("u",), K_l, Injection.STATE, DT, runtime=Runtime(delay))
    elif kind == "bank":
        A_b = np.zeros((9, 9))
        A_b[:2, [0, 2]], A_b[2:4, 0], A_b[2:4, 2:4] = [[0.9, 0.1], [0.2, 0.5]], 0.1, np.diag([0.8, 0.5])
        A_b[4, 4], A_b[5:7, 2], A_b[7:9, 4] = 0.9, 0.2, 0.3
        of_gaps = map(
            np.array, ([0.95], [[0.2, 0.1], [0.1, 0.3]], [0.2, 0.5], *([v] for v in (0.5, 0.05, 0.2, 0.5, 4, 2)))
        )
        bank = FilterBank(2, 0.1 * np.ones((9, 10)), *of_gaps, np.array([0.7]))
        lifting = Lifting(("x", "v", "z1", "z2", "w", "xs", "vs", "xu", "vu"))
        still = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((9, 0)), np.zeros((9, 1)), DT)
        o = Observer("b", lifting, A_b, 0.1 * np.ones((9, 1)), (0,), ("u",), still, Injection.STATE, DT, bank=bank)
    else:
        o = unstable(runtime=Runtime(delay=delay, upper=np.array([2.5, np.inf])))
    if not loops:
        monkeypatch.setattr("kros.observer.simulate.library", lambda: None)
    borders = [0, 1, 2, 5, 65, 66, 110, 150, 185, 200, 310, 350, 390, 400]
    for i in range(0, y.shape[1], 4):
        whole, status = run_with_status(o, y[:, i : i + 1], u[:, i : i + 1])
        course = Course(o)
        runs = [course.take(y[a:b, i : i + 1], u[a:b, i : i + 1]) for a, b in pairwise(borders)]
        in_blocks = np.concatenate([run.estimates for run in runs])
        np.testing.assert_allclose(in_blocks, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())
        np.testing.assert_array_equal(np.concatenate([run.status for run in runs]), status)
