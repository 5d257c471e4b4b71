"""The mean motion: what other units did at the same sample of the same motion, for machines that repeat themselves. It looks at no measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SAME = 0.01  # of the largest input: RMS difference of inputs that are the same motion


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
