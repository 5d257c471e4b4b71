r"""Where an observer starts in a machine that moves already: data, learned from training episodes (`predictor.start`).

From rest, `ObserverData.initial` is exact. A machine in motion shows at the first sample that it moves, ``y_0 - M u_0`` and the inputs that no
measurement follows are not zero, and more with every sample: so the first estimate is that of rest and a linear map of the first measurement and
inputs, and the first few innovations correct hidden states by gains of their own, as those of a Kalman filter that does not know where it starts,

.. math:: \hat x_0 = x_{rest}(y_0) + G [y_0; u_0], \qquad \hat x_{k+1} = \dots + S_k (y_k - C \hat x_k), \quad k < K .

From then on the observer is what it was. All of this is zero where a machine starts at rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Start:
    """Start of an observer in motion.

    Parameters
    ----------
    gain : ndarray, shape (n, q + m)
        G, of the first measurement and the first recorded inputs.
    corrections : ndarray, shape (count, n, q)
        S_k, of the first innovations, beside the observer's own correction.

    Raises
    ------
    DataError
        When a number is not finite.
    """

    gain: Array
    corrections: Array

    def __post_init__(self) -> None:
        for name in ("gain", "corrections"):
            values = np.asarray(getattr(self, name), dtype=float)
            object.__setattr__(self, name, values)
            if not np.isfinite(values).all():
                raise DataError(f"Start of an observer: {name} should hold finite numbers.")

    def __len__(self) -> int:
        """Samples until the observer is what it is from then on."""
        return len(self.corrections)

    def require_fit(self, name: str, n: int, q: int, m: int) -> None:
        """Refuse arrays of another size than the observer's."""
        if self.gain.shape != (n, q + m) or self.corrections.shape[1:] != (n, q):
            raise DimensionError(
                f"Observer {name}: start_in_motion.gain should have shape {(n, q + m)} and start_in_motion.corrections (count, {n}, {q}), "
                f"found {self.gain.shape} and {self.corrections.shape}."
            )

    def moved(self, y: Array, u: Array) -> Array:
        """Return what motion adds to the first estimate, shape (..., n): nothing where a measurement or an input is not known."""
        known = np.asarray(np.isfinite(y).all(axis=-1) & np.isfinite(u).all(axis=-1))
        first = np.where(known[..., None], np.concatenate([y, u], axis=-1), 0.0)
        return np.asarray(first @ self.gain.T)

    def correction(self, since: npt.NDArray[np.int64], innovation: Array) -> Array:
        """Return what is added to the next estimate, shape (batch, n), `since` so many samples after the start, shape (batch,)."""
        at = np.minimum(since, len(self) - 1)
        return np.where((since < len(self))[:, None], np.einsum("bnq,bq->bn", self.corrections[at], innovation), 0.0)

    def times(self, x: Array, y: Array, u: Array) -> Start:
        """Return the start in other units of measure, by the factors of states, measurements and inputs."""
        return Start(self.gain * x[:, None] / np.concatenate([y, u]), self.corrections * x[:, None] / y)

    def turned(self, turn: Array) -> Start:
        """Return the start for states ``turn @ x``, shape (n', n)."""
        return Start(turn @ self.gain, turn @ self.corrections)

    def content(self) -> dict[str, Any]:
        """Return what an observer's file holds of it."""
        return {"gain": self.gain.tolist(), "corrections": self.corrections.tolist()}

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> Start:
        """Read what `content` returned."""
        return cls(np.array(content["gain"], dtype=float), np.array(content["corrections"], dtype=float))
