"""The baseline for machines that repeat a motion: made from training episodes whose inputs are those of the episodes it is asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..data.population import EpisodeKey, Population
from .estimators import Baseline
from .validation import TrainingSet

Array = npt.NDArray[np.float64]
SAME = 0.01  # of the largest input: RMS difference of inputs that are the same motion
_SAMPLES = 5_000_000  # read at most, once every unit and condition has been read


@dataclass(frozen=True, eq=False)
class MeanProfile:
    """Mean states of motions that are known by their inputs."""

    n_states: int
    estimated: tuple[int, ...]
    inputs: Sequence[Array]  # (n_samples, m)
    states: Sequence[Array]  # (n_samples, h)

    @cached_property
    def sizes(self) -> Array:
        """Largest absolute values of the inputs, see `sizes_of`."""
        return sizes_of(self.inputs)

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Estimate a batch from its first sample on, each member by the motion whose inputs are nearest to its own."""
        del parameters
        estimate = np.full((*y.shape[:2], self.n_states), np.nan)
        for i in range(y.shape[1]):
            distance = [difference(u[:, i], motion, self.sizes) for motion in self.inputs]
            estimate[:, i, list(self.estimated)] = held(self.states[int(np.argmin(distance))], len(y))
        return estimate


def held(signal: Array, n_samples: int) -> Array:
    """Return a signal, shape (n, ...), of so many samples: cut, or held at its last one."""
    longer = len(signal) >= n_samples
    return signal[:n_samples] if longer else np.asarray(signal[np.minimum(np.arange(n_samples), len(signal) - 1)])


def sizes_of(inputs: Sequence[Array]) -> Array:
    """Return the largest absolute value of every input over motions, one where it is always zero."""
    largest = np.max([np.abs(motion).max(axis=0) for motion in inputs], axis=0)
    return np.asarray(np.where(largest > 0, largest, 1.0))


def difference(u: Array, motion: Array, sizes: Array) -> float:
    """Return the RMS difference of inputs, shape (n_samples, m), as a share of `sizes`; the largest of all inputs."""
    return float(np.sqrt(np.mean(((u - held(motion, len(u))) / sizes) ** 2, axis=0)).max())


def make_mean_profile(
    training: TrainingSet, measured: tuple[int, ...], population: Population, keys: Iterable[EpisodeKey]
) -> Baseline:
    """Average the states of training episodes that are the same motions as some episodes, over units, once for every unit without it."""
    n = len(population.states)
    estimated = [i for i in range(n) if i not in measured]
    if not population.inputs or not estimated:
        raise DataError("Mean profile: it needs inputs that tell a motion, and a state that is not measured.")
    motions: list[Array] = []
    named: list[EpisodeKey] = []
    for key in keys:
        u = population.read_parts(key)[1]
        sizes = sizes_of([*motions, u])
        if not motions or min(difference(u, motion, sizes) for motion in motions) > SAME:
            motions.append(u)
            named.append(key)
    sizes = sizes_of(motions)
    sums: list[dict[str, Array]] = [{} for _ in motions]
    counts: list[dict[str, int]] = [{} for _ in motions]
    closest = np.full(len(motions), np.inf)
    total, read, groups = 0, 0, len({(key.unit, key.condition) for key in training.keys})
    for part in training.one_by_one():
        (unit,), states, u = part.batch.units, part.batch.states[:, 0, estimated], part.batch.inputs[:, 0]
        apart = np.array([difference(motion, u, sizes) for motion in motions])
        closest = np.minimum(closest, apart)
        if apart.min() <= SAME:
            at = int(apart.argmin())
            profile = held(states, len(motions[at]))
            sums[at][unit] = sums[at].get(unit, 0.0) + profile
            counts[at][unit] = counts[at].get(unit, 0) + 1
        read, total = read + 1, total + len(states)
        if read >= groups and total > _SAMPLES:
            break
    for key, found, apart_by in zip(named, sums, closest, strict=True):
        if len(found) < 2:
            raise DataError(
                f"Mean profile: held-out episode {key} is no motion that training episodes of two units repeat; the nearest inputs differ by "
                f"{100 * apart_by:.3g} % of the largest (RMS), {100 * SAME:g} % counts as the same."
            )
    profiles = [{unit: total / counts[at][unit] for unit, total in found.items()} for at, found in enumerate(sums)]

    def without(left_out: str) -> MeanProfile:
        means = [np.mean([p for unit, p in found.items() if unit != left_out], axis=0) for found in profiles]
        return MeanProfile(n, tuple(estimated), motions, means)

    by_unit = {unit: without(unit) for unit in dict.fromkeys(unit for found in profiles for unit in found)}
    facts = {
        "status": "averaged",
        "motions": len(motions),
        "episodes": sum(sum(c.values()) for c in counts),
        "left_out": "the unit under test",
    }
    return Baseline(
        by_unit | {"": without("")},
        measured,
        tuple(estimated),
        facts,
        takes_missing=True,
        restarts=False,
        seen=training.seen,
    )
