"""All observers and estimators over all test episodes of a population: 156 episodes of 19 000 samples, as in the paper's recordings.

    python benchmarks/observers_in_batch.py [--episodes 156] [--samples 19000]

Signals are random: what is timed does not depend on them. Prints processor time, which other work on the machine does not inflate much.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from kros.core.lti import StateSpace, gain
from kros.data import EpisodeBatch, EpisodeKey
from kros.evaluate.errors import errors_of
from kros.lifting import Lifting
from kros.observer import (
    Observer,
    Runtime,
    run_observer,
)
from kros.observer.baselines.difference import FilteredDifference
from kros.observer.baselines.extended_kalman import ExtendedKalman
from kros.observer.baselines.learned import Moments
from kros.observer.simulate import run_observers
from kros.synthesis import Injection

DT = 0.001
KOOPMAN = Lifting(("position", "velocity", "current"), ("sin(100*position + phase)",), ("phase",))
LINEAR = Lifting(("position", "velocity", "current"))
ORDERS = (0, 4, 9, 12)  # of the corrections: gains, worst-case H2, residual-shaped, the paper's
COUNTS = (8, 2, 2, 2)  # of either lifting, for refined and plain models together
TOGETHER, EPISODES = 2, 32  # observers and episodes that a study of this size runs side by side


def main() -> None:
    """Time everything and print the sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=156)
    parser.add_argument("--samples", type=int, default=19_000)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    blocks = [
        Block.of(rng, options.samples, min(EPISODES, options.episodes - i))
        for i in range(0, options.episodes, EPISODES)
    ]
    found: dict[str, float] = {}

    def timed(name: str, work: Callable[[], Any], count: float = 1) -> Any:
        start = time.process_time()
        result = work()
        found[name] = count * (time.process_time() - start)
        sys.stdout.write(f"{name:58s} {found[name]:7.2f} s\n")
        sys.stdout.flush()
        return result

    def every(run: Callable[[Block], Any]) -> None:
        for block in blocks:
            run(block)

    for lifting, name in ((KOOPMAN, "Koopman"), (LINEAR, "linear")):
        timed(f"{name} formulas, once a process", partial(load, [observer(lifting, 0)], blocks[0].first(2)))
        for order, count in zip(ORDERS, COUNTS, strict=True):
            work = partial(every, partial(side_by_side, [observer(lifting, order)] * TOGETHER))
            timed(f"{count} {name} observers, {order} filter states", work, count // TOGETHER)
    A = np.pad(0.3 * rng.normal(size=(3, 4)), ((0, 1), (0, 0)))
    extended = ExtendedKalman(KOOPMAN, A, np.zeros((4, 2)), (0,), 0.01 * np.eye(3), np.eye(1), np.eye(3))
    timed("extended Kalman filter", lambda: every(lambda block: extended.run(block.y, block.u, block.phase)))
    timed(
        "filtered difference",
        lambda: every(lambda block: FilteredDifference(3, ((0, 1),), 100.0, DT).run(block.y, block.u)),
    )
    moments = timed(
        "learned estimator, moments",
        lambda: Moments.of((part for block in blocks for part in block.one_by_one()), (0,), 10),
    )
    timed("learned estimator", lambda: every(lambda block: moments.estimator().run(block.y, block.u, block.phase)))
    estimates = 2 * sum(COUNTS) + 3
    made = [[*run_observers([observer(LINEAR, 0)] * TOGETHER, block.y, block.u)] for block in blocks]
    band = 40.0, 60.0
    summaries = partial(
        every,
        lambda block: [errors_of(x, block.states, block.lengths, DT, band) for x in made[blocks.index(block)]],
    )
    timed(f"errors and spectra of {estimates} estimates", summaries, estimates / TOGETHER)
    sys.stdout.write(f"{'all of the above':58s} {sum(found.values()):7.2f} s\n\nnot part of a study:\n")
    short, block = min(10_000, options.samples), blocks[0]
    timed(
        "20 candidates side by side, 32 episodes of 10 s",
        lambda: [*run_observers([observer(KOOPMAN, 0)] * 20, block.y[:short], block.u[:short], block.phase)],
    )
    late = observer(KOOPMAN, 9, Runtime(delay=3, upper=np.array([9.0, 9.0, 9.0])))
    timed(
        "an observer with a delay of 3 samples and limits",
        lambda: every(lambda block: run_observer(late, block.y, block.u, block.phase)),
    )


@dataclass(frozen=True, eq=False)
class Block:
    """Episodes that run side by side, the batch innermost in memory as in a study."""

    states: np.ndarray
    y: np.ndarray
    u: np.ndarray
    phase: dict[str, np.ndarray]
    lengths: np.ndarray

    @classmethod
    def of(cls, rng: np.random.Generator, samples: int, episodes: int) -> Block:
        """Draw signals."""
        states, u = (0.1 * rng.normal(size=(samples, width, episodes)).swapaxes(1, 2) for width in (3, 2))
        return cls(
            states,
            np.ascontiguousarray(states[..., :1]),
            u,
            {"phase": rng.uniform(-3, 3, size=episodes)},
            np.full(episodes, samples),
        )

    def first(self, samples: int) -> Block:
        """The first samples."""
        return replace(
            self,
            states=self.states[:samples],
            y=self.y[:samples],
            u=self.u[:samples],
            lengths=np.minimum(self.lengths, samples),
        )

    def of_lifting(self, lifting: Lifting) -> dict[str, np.ndarray] | None:
        """Parameters of a lifting; None where it has none."""
        return self.phase if lifting.parameters else None

    def one_by_one(self) -> Iterator[EpisodeBatch]:
        """Every episode by itself."""
        keys = tuple(EpisodeKey("a", "", str(i)) for i in range(len(self.lengths)))
        batch = EpisodeBatch(keys, self.lengths, self.states, self.u, DT, self.phase)
        return (batch.take([i]) for i in range(len(keys)))


def side_by_side(observers: list[Observer], block: Block) -> list[np.ndarray]:
    """Run observers of one model on some episodes."""
    return [*run_observers(observers, block.y, block.u, block.of_lifting(observers[0].lifting))]


def load(observers: list[Observer], block: Block) -> None:
    """Run observers so that their formulas and the compiled loops are there."""
    for each in observers:
        side_by_side([each], block)


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
