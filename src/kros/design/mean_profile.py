"""The baseline for machines that repeat a motion: the mean of training episodes that have the same inputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..data.population import EpisodeKey, Population
from .baselines import DEFAULT, Baseline, BaselineSettings
from .validation import TrainingSet

Array = npt.NDArray[np.float64]


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
        """Estimate a batch from its first sample on, each member by the motion whose inputs are nearest."""
        del parameters
        estimate = np.full((*y.shape[:2], self.n_states), np.nan)
        for i in range(y.shape[1]):
            distance = [difference(u[:, i], motion, self.sizes) for motion in self.inputs]
            estimate[:, i, list(self.estimated)] = held(self.states[int(np.argmin(distance))], len(y))
        return estimate


def held(signal: Array, n_samples: int) -> Array:
    """Return a signal, shape (n, ...), of `n_samples` samples: cut, or held at its last one."""
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
    training: TrainingSet,
    measured: tuple[int, ...],
    population: Population,
    keys: Iterable[EpisodeKey],
    settings: BaselineSettings = DEFAULT,
) -> Baseline:
    """Average the states of training episodes that have the same motions, over units, and without each unit."""
    n = len(population.states)
    estimated = tuple(i for i in range(n) if i not in measured)
    if not population.inputs or not estimated:
        raise DataError("Mean profile: it needs inputs that identify a motion, and a state that is not measured.")
    motions = different_motions(population, keys, settings.same_motion)
    means, closest, episodes = unit_means(training, list(motions.values()), estimated, settings)
    for key, of_units, apart in zip(motions, means, closest, strict=True):
        if len(of_units) < 2:
            distance = f"{100 * apart:.3g} % of the largest (RMS), at most {100 * settings.same_motion:g} % is allowed"
            raise DataError(
                f"Mean profile: the inputs of held-out {key} do not occur in training episodes of two units; the "
                f"nearest inputs differ by {distance}."
            )

    def without(left_out: str) -> MeanProfile:
        states = [np.mean([p for unit, p in of_units.items() if unit != left_out], axis=0) for of_units in means]
        return MeanProfile(n, estimated, list(motions.values()), states)

    units = dict.fromkeys(unit for of_units in means for unit in of_units)
    facts = {"status": "averaged", "motions": len(motions), "episodes": episodes, "left_out": "the unit under test"}
    by_unit = {unit: without(unit) for unit in (*units, "")}
    return Baseline(by_unit, measured, estimated, facts, restarts=False, seen=training.seen)


def different_motions(population: Population, keys: Iterable[EpisodeKey], same: float) -> dict[EpisodeKey, Array]:
    """Return the inputs of episodes that differ, (n_samples, m) each."""
    motions: dict[EpisodeKey, Array] = {}
    for key in keys:
        u = population.read_parts(key)[1]
        sizes = sizes_of([*motions.values(), u])
        if all(difference(u, motion, sizes) > same for motion in motions.values()):
            motions[key] = u
    return motions


def unit_means(
    training: TrainingSet, motions: Sequence[Array], estimated: Sequence[int], settings: BaselineSettings
) -> tuple[list[dict[str, Array]], Array, int]:
    """Return the mean states of every motion by unit, how near inputs came to it, and the episodes that were used."""
    sizes, closest = sizes_of(motions), np.full(len(motions), np.inf)
    profiles: list[dict[str, list[Array]]] = [{} for _ in motions]
    n_samples, read, groups = 0, 0, len({(key.unit, key.condition) for key in training.keys})
    for part in training.one_by_one():
        (unit,), states, u = part.units, part.states[:, 0, list(estimated)], part.inputs[:, 0]
        apart = np.array([difference(motion, u, sizes) for motion in motions])
        closest = np.minimum(closest, apart)
        if apart.min() <= settings.same_motion:
            at = int(apart.argmin())
            profiles[at].setdefault(unit, []).append(held(states, len(motions[at])))
        read, n_samples = read + 1, n_samples + len(states)
        if read >= groups and n_samples > settings.profile_samples:
            break
    means: list[dict[str, Array]] = [
        {unit: np.mean(some, axis=0) for unit, some in of_units.items()} for of_units in profiles
    ]
    return means, closest, sum(len(some) for of_units in profiles for some in of_units.values())
