r"""A learned estimator without a model: ridge regression of the hidden states on the recent past, as a yardstick without any guarantee.

What it sees at sample k - 1 and before is

    z = [ y - c - M u ;  u ;  sigma(y) ;  d sigma / dy (y) ]

the measurement less what the inputs alone say of it (for a drive: the tracking error; of a measurement that the inputs do not explain, such as a
position by a voltage, c alone is taken off), the recorded inputs, and those lifted functions that read measured states alone, with their slopes (for a
drive: sine and cosine of the gearbox angle). The estimate is linear in these samples; what came before the first one is taken to equal it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...core.linalg import least_squares
from ...lifting import Lifting

Array = npt.NDArray[np.float64]
TAPS = 80
_EXPLAINED = 0.5  # share of a measurement's variance


@dataclass(frozen=True, eq=False)
class Features:
    """The channels that the estimator looks at."""

    lifting: Lifting
    measured: tuple[int, ...]
    static: Array  # (q, 1 + m)
    taps: int = TAPS

    @classmethod
    def of(cls, lifting: Lifting, measured: Sequence[int], y: Array, u: Array, taps: int = TAPS) -> Features:
        """Fit the static part on recordings y (n_samples, batch, q) and u (n_samples, batch, m)."""
        inputs = np.concatenate([np.ones((*u.shape[:-1], 1)), u], axis=-1).reshape(-1, 1 + u.shape[-1])
        outputs = y.reshape(-1, y.shape[-1])
        static = least_squares(inputs, outputs).T
        mean = outputs.mean(axis=0)
        alone = np.mean((outputs - inputs @ static.T) ** 2, axis=0) > (1 - _EXPLAINED) * np.mean(
            (outputs - mean) ** 2, axis=0
        )
        static[alone] = 0.0
        static[alone, 0] = mean[alone]
        return cls(lifting, tuple(measured), static, taps)

    @cached_property
    def visible(self) -> tuple[int, ...]:
        """Lifted functions that read measured states and parameters alone."""
        seen = {self.lifting.states[i] for i in self.measured} | set(self.lifting.parameters)
        return tuple(i for i, formula in enumerate(self.lifting.formulas) if set(formula.used) <= seen)

    @cached_property
    def _bare(self) -> Lifting:
        """The lifting with these functions alone."""
        return replace(
            self.lifting, functions=tuple(self.lifting.functions[i] for i in self.visible), input_functions=()
        )

    def channels(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Return z, shape (n_samples, batch, channels), of y (n_samples, batch, q) and u (n_samples, batch, m); parameters of shape (batch,)."""
        if y.shape[:-1] != u.shape[:-1] or y.shape[-1] != len(self.measured) or u.shape[-1] + 1 != self.static.shape[1]:
            raise DimensionError(
                f"Learned estimator: expected {len(self.measured)} measurements and {self.static.shape[1] - 1} inputs, found {y.shape} and {u.shape}."
            )
        parts = [y - self.static[:, 0] - u @ self.static[:, 1:].T, u]
        if self.visible:
            bare = self._bare
            x = np.zeros((*y.shape[:-1], bare.n_states))
            x[..., list(self.measured)] = y
            slopes = bare.slopes(x, parameters)[..., list(self.measured)]
            parts += [bare.lift(x, parameters)[..., bare.n_states :], slopes.reshape(*y.shape[:-1], -1)]
        return np.concatenate(parts, axis=-1)


@dataclass(frozen=True, eq=False)
class Learned:
    """The trained estimator."""

    features: Features
    estimated: tuple[int, ...]
    constant: Array  # (h,)
    response: Array  # (channels, taps, h)

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Estimate a batch from y (n_samples, batch, q) and u (n_samples, batch, m), shape (n_samples, batch, n)."""
        from scipy.fft import irfft, next_fast_len, rfft

        z = self.features.channels(y, u, parameters)
        z = np.concatenate([np.repeat(z[:1], self.features.taps, axis=0), z[:-1]])
        first, z = z[:1], z - z[:1]
        size = next_fast_len(len(z) + self.features.taps, real=True)
        spectrum = np.moveaxis(rfft(z, size, axis=0), -1, 1)
        estimate = np.full((*y.shape[:-1], self.features.lifting.n_states), np.nan)
        for column, state in enumerate(self.estimated):
            weights = self.response[..., column]
            moving = irfft(np.einsum("fcb,cf->fb", spectrum, rfft(weights, size, axis=1), optimize=True), size, axis=0)
            estimate[..., state] = (
                self.constant[column] + first[0] @ weights.sum(axis=1) + moving[self.features.taps - 1 : len(z)]
            )
        return estimate
