"""Delays: which earlier values a lifting reads, and how they move on from sample to sample.

A window is what a lifting is evaluated on: the present states, then the earlier values that its formulas name,

    w_k = [x_k, q_{k-1}, ..., q_{k-d}, ...]        for every delayed quantity q, a state or an input, to its depth d

At the next sample each earlier value takes the place behind it; the shift is exact, no model is asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError
from .formula import base_and_delay, delayed_name

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Window:
    """Layout of a window."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    depths: tuple[tuple[str, int], ...] = ()  # deepest delay of every delayed quantity

    @classmethod
    def of(cls, states: tuple[str, ...], inputs: tuple[str, ...], used: Iterable[str]) -> Window:
        """Collect the delays from the names that formulas use."""
        depths: dict[str, int] = {}
        for base, delay in map(base_and_delay, used):
            depths[base] = max(depths.get(base, 0), delay)
        return cls(states, inputs, tuple((q, depths[q]) for q in states + inputs if depths.get(q)))

    @property
    def history(self) -> int:
        """Deepest delay in samples."""
        return max((depth for _, depth in self.depths), default=0)

    @cached_property
    def delayed(self) -> tuple[tuple[str, int], ...]:
        """The quantity behind every earlier value, and how many samples before it is meant."""
        return tuple((q, d) for q, depth in self.depths for d in range(1, depth + 1))

    @cached_property
    def earlier(self) -> tuple[str, ...]:
        """Names of the earlier values, in the order of the window."""
        return tuple(delayed_name(q, d) for q, d in self.delayed)

    @property
    def quantities(self) -> tuple[tuple[str, int], ...]:
        """The quantity behind every entry, and how many samples before it is meant."""
        return (*((state, 0) for state in self.states), *self.delayed)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all entries."""
        return self.states + self.earlier

    @cached_property
    def shift(self) -> Index:
        """Entry of ``[window, inputs]`` that every earlier value has at the next sample."""
        entries = (*self.names, *self.inputs)
        return np.array([entries.index(delayed_name(q, d - 1)) for q, d in self.delayed], dtype=np.intp)

    @cached_property
    def present(self) -> Index:
        """Entry of ``[window, inputs]`` of the quantity that every earlier value is one of."""
        entries = (*self.names, *self.inputs)
        return np.array([entries.index(q) for q, _ in self.delayed], dtype=np.intp)

    def advance(self, window: Array, u: Array) -> Array:
        """Return the earlier values of the next sample, shape (..., n_earlier), from a window and its inputs."""
        return np.concatenate([window, u], axis=-1)[..., self.shift]

    def hold(self, x: Array, u: Array) -> Array:
        """Return earlier values that all equal the present ones, shape (..., n_earlier)."""
        padding = np.zeros((*x.shape[:-1], len(self.earlier)))
        return np.concatenate([x, padding, u], axis=-1)[..., self.present]

    def slide(self, x: Array, u: Array) -> Array:
        """Return the windows of a recording, shape (..., n_samples - history, n_window)."""
        if not self.depths:
            return x
        self.require(x.shape[-2])
        columns = {name: x[..., i] for i, name in enumerate(self.states)}
        columns |= {name: u[..., i] for i, name in enumerate(self.inputs)}
        h, end = self.history, x.shape[-2]
        earlier = [columns[q][..., h - d : end - d] for q, d in self.delayed]
        return np.concatenate([x[..., h:, :], np.stack(earlier, axis=-1)], axis=-1)

    def require(self, n_samples: int, beyond: int = 0) -> None:
        """Refuse a recording that is shorter than the history and `beyond` samples after its first window."""
        needed = self.history + 1 + beyond
        if n_samples < needed:
            name, depth = max(self.depths, key=lambda item: item[1], default=("", 0))
            reason = f" for the delay of {depth} in {name!r}" if self.depths else ""
            problem = f"needs at least {needed} samples{reason}, found {n_samples}"
            raise DataError(f"Lifting a recording: {problem}; leave the episode out or use shorter delays.")

    def require_inputs(self, u: Array) -> None:
        """Refuse inputs that are not those the formulas were written for."""
        if self.inputs and u.shape[-1] != len(self.inputs):
            needed = f"{len(self.inputs)} inputs {self.inputs} on the last axis"
            raise DimensionError(f"Lifting: expected {needed}, found shape {u.shape}.")

    def values(self, window: Array, u: Array | None = None) -> Mapping[str, Array]:
        """Return the columns by name, the present inputs with them where they are given."""
        named = {name: window[..., i] for i, name in enumerate(self.names)}
        return named if u is None else named | {name: u[..., i] for i, name in enumerate(self.inputs)}
