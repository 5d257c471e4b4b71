r"""Channels divided by their ranges: where everything is identified, so that units of measure change nothing.

With the ranges ``X`` of the lifted states and ``U`` of the model's inputs as diagonal matrices,

.. math:: z = X^{-1} x, \qquad A_z = X^{-1} A X, \qquad B_z = X^{-1} B U.

Lifted functions have a range of their own, as states and inputs do. Only a regularisation, a threshold or a penalty
sees the difference, and all of them are meant for signals of about one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..lifting import Lifting
from .edmd import KoopmanMatrices, edmd
from .factors import Factor

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ranges:
    """Ranges of a model's channels."""

    outputs: Array  # (n_lifted,)
    inputs: Array  # (m,)

    @classmethod
    def of(cls, factor: Factor, n_lifted: int, rows: Any = slice(None)) -> Ranges:
        """Return the largest magnitudes in the training of some units; one for a channel that is always zero."""
        peak = factor.peak[rows].max(axis=0)
        peak = np.where(peak > 0, peak, 1.0)
        return cls(peak[:n_lifted], peak[n_lifted:])

    @property
    def inverse(self) -> Ranges:
        """Ranges that lead back."""
        return Ranges(1 / self.outputs, 1 / self.inputs)

    def sizes(self, lifting: Lifting, recorded: tuple[str, ...]) -> dict[str, float]:
        """Return the ranges by name: of states, lifted functions, recorded inputs and functions of these."""
        names = (*lifting.names, *recorded, *lifting.input_functions)
        return dict(zip(names, np.concatenate([self.outputs, self.inputs]).tolist(), strict=True))

    def normalise(self, models: KoopmanMatrices) -> KoopmanMatrices:
        """Return models of channels divided by the ranges, batched."""
        x, u = self.outputs, self.inputs
        return KoopmanMatrices(models.A * x / x[:, None], models.B * u / x[:, None])

    def restore(self, models: KoopmanMatrices) -> KoopmanMatrices:
        """Return models of the channels as recorded from those of channels divided by the ranges."""
        return self.inverse.normalise(models)

    def triangles(self, R: Array) -> Array:
        """Return factors of ``[Psi | Theta_plus]`` of channels divided by the ranges."""
        return np.asarray(R / np.concatenate([self.outputs, self.inputs, self.outputs]))

    def factor(self, factor: Factor) -> Factor:
        """Return the same with what else a factor holds."""
        ends = factor.input_range
        peak = factor.peak / np.concatenate([self.outputs, self.inputs])
        ends = None if ends is None else ends / self.inputs[: ends.shape[-1]]
        return replace(factor, R=self.triangles(factor.R), peak=peak, input_range=ends)

    def edmd(self, R: Array, alpha: npt.ArrayLike = 0.0) -> KoopmanMatrices:
        """Return EDMD models of recorded channels whose regularisation acts on channels divided by the ranges."""
        return self.restore(edmd(self.triangles(R), len(self.outputs), alpha))
