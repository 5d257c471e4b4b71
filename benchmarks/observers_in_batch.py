"""All observers and estimators over all test episodes of a population: 156 episodes of 19 000 samples, as in the paper's recordings.

    python benchmarks/observers_in_batch.py [--episodes 156] [--samples 19000]

Signals are random: what is timed does not depend on them. Prints processor time, which other work on the machine does not inflate much.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from kros.core.lti import StateSpace, gain
from kros.data import EpisodeBatch, EpisodeKey
from kros.evaluate.errors import summarise
from kros.lifting import Lifting
from kros.observer import ExtendedKalman, FilteredDifference, Observer, Runtime, run_observer, run_observers, track_parameter
from kros.observer.baselines.learned import Features
from kros.observer.baselines.learned_moments import Moments
from kros.synthesis import Injection

DT = 0.001
KOOPMAN = Lifting(("position", "velocity", "current"), ("sin(100*position + phase)",), ("phase",))
LINEAR = Lifting(("position", "velocity", "current"))
ORDERS = (0, 4, 9, 12)  # of the corrections: gains, worst-case H2, residual-shaped, the paper's
COUNTS = (8, 2, 2, 2)  # of either lifting, for refined and plain models together
MEMORIES = 12  # states of the subspace-identified predictor
TOGETHER = 2  # run side by side: at this size a study has memory for no more


def main() -> None:
    """Time everything and print the sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=156)
    parser.add_argument("--samples", type=int, default=19_000)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    shape = (options.samples, options.episodes)
    states, u = 0.1 * rng.normal(size=(*shape, 3)), 0.1 * rng.normal(size=(*shape, 2))
    y, phase = np.ascontiguousarray(states[..., :1]), {"phase": rng.uniform(-3, 3, size=shape[1])}
    lengths = np.full(shape[1], shape[0])
    found: dict[str, float] = {}

    def timed(name: str, work: Callable[[], Any], count: int = 1) -> Any:
        start = time.process_time()
        result = work()
        found[name] = count * (time.process_time() - start)
        sys.stdout.write(f"{name:58s} {found[name]:7.2f} s\n")
        sys.stdout.flush()
        return result

    for lifting, name in ((KOOPMAN, "Koopman"), (LINEAR, "linear")):
        values = phase if lifting.parameters else None
        for order, count in zip(ORDERS, COUNTS, strict=True):
            work = partial(run_observers, [observer(lifting, order)] * TOGETHER, y, u, values)
            estimate = timed(f"{count} {name} observers, {order} filter states", work, count // TOGETHER)[0]
        work = partial(run_observer, observer(with_internal(lifting), 0), y, u, values)
        timed(f"1 {name} subspace-identified predictor of {MEMORIES} states", work)
    A = np.pad(0.3 * rng.normal(size=(3, 4)), ((0, 1), (0, 0)))
    extended = ExtendedKalman(KOOPMAN, A, np.zeros((4, 2)), (0,), ("a", "b"), 0.01 * np.eye(3), np.eye(1), np.eye(3))
    timed("extended Kalman filter", lambda: extended.run(y, u, phase))
    timed("filtered difference", lambda: FilteredDifference(3, ((0, 1),), 100.0, DT).run(y, u))
    features = Features.of(KOOPMAN, (0,), y, u)
    few = {"phase": phase["phase"][:36]}
    batch = EpisodeBatch(tuple(EpisodeKey("a", "", str(i)) for i in range(shape[1])), lengths, states, u, DT, phase)
    moments = timed(
        "learned estimator, moments",
        lambda: Moments.of(features, (batch.take([i]) for i in range(shape[1]))),
    )
    timed("learned estimator", lambda: moments.estimator().run(y, u, phase))
    estimates = 2 * (sum(COUNTS) + 1) + 3
    timed(f"errors and spectra of {estimates} estimates", lambda: summarise(estimate, states, lengths, DT), estimates)
    sys.stdout.write(f"{'all of the above':58s} {sum(found.values()):7.2f} s\n\nnot part of a study:\n")
    timed(
        "20 candidates side by side, 36 episodes of 10 s",
        lambda: run_observers([observer(KOOPMAN, 0)] * 20, y[:10_000, :36], u[:10_000, :36], few),
    )
    late = observer(KOOPMAN, 9, Runtime(delay=3, upper=np.array([9.0, 9.0, 9.0])))
    timed("an observer with a delay of 3 samples and limits", lambda: run_observer(late, y, u, phase))
    timed("phase-locked loop", lambda: track_parameter(observer(KOOPMAN, 9), y, u, phase))


def with_internal(lifting: Lifting) -> Lifting:
    """The same lifting with states of the observer's own."""
    return replace(lifting, states=(*lifting.states, *(f"memory_{i + 1}" for i in range(MEMORIES))))


def observer(lifting: Lifting, order: int, runtime: Runtime | None = None) -> Observer:
    """A stable observer of a size."""
    rng = np.random.default_rng(order)
    n = lifting.n_lifted
    K = gain(0.01 * np.ones((n, 1)), DT)
    if order:
        K = StateSpace(0.5 * np.eye(order), rng.normal(size=(order, 1)), 0.01 * rng.normal(size=(n, order)), K.D, DT)
    return Observer(
        "o",
        lifting,
        0.5 * np.linalg.qr(rng.normal(size=(n, n)))[0],
        rng.normal(size=(n, 2)),
        (0,),
        ("a", "b"),
        K,
        Injection.STATE,
        DT,
        runtime=runtime or Runtime(),
    )


if __name__ == "__main__":
    main()
