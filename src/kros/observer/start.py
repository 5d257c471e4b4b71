r"""Where an observer starts in a machine that moves already: data, learned from training episodes (`predictor.start`).

From rest, `ObserverData.initial` is exact. A machine in motion shows at the first sample that it moves, ``y_0 - M u_0`` and the inputs that no
measurement follows are not zero, and more with every sample: so the first estimate is that of rest and a linear map of the first measurement and
inputs, and the first few innovations correct hidden states by gains of their own, as those of a Kalman filter that does not know where it starts,

.. math:: \hat x_0 = x_{rest}(y_0) + G [y_0; u_0], \qquad \hat x_{k+1} = \dots + S_k (y_k - C \hat x_k), \quad k < K .

From then on the observer is what it was. Where the first sample shows a machine at rest nothing is added, not even what noise would say of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Start:
    """Start of an observer in motion."""

    gain: Array  # (n, q + m)
    corrections: Array  # (count, n, q)
    rest: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (p, q + m)

    def __post_init__(self) -> None:
        for name in ("gain", "corrections", "rest"):
            values = np.asarray(getattr(self, name), dtype=float)
            object.__setattr__(self, name, values)
            if not np.isfinite(values).all():
                raise DataError(f"Start of an observer: {name} should hold finite numbers.")

    def __len__(self) -> int:
        """Samples until the observer is what it is from then on."""
        return len(self.corrections)

    def require_fit(self, name: str, n: int, q: int, m: int) -> None:
        """Refuse arrays of another size than the observer's."""
        fits = self.gain.shape == (n, q + m) and self.corrections.shape[1:] == (n, q)
        if not fits or (len(self.rest) and self.rest.shape[1:] != (q + m,)):
            raise DimensionError(
                f"Observer {name}: start_in_motion should have gain {(n, q + m)}, corrections (count, {n}, {q}) and rest (p, {q + m}), "
                f"found {self.gain.shape}, {self.corrections.shape} and {self.rest.shape}."
            )

    def at_rest(self, y: Array, u: Array) -> npt.NDArray[np.bool_]:
        """Return whether the first sample shows a machine at rest, shape (...)."""
        shown = np.concatenate([y, u], axis=-1)
        if not len(self.rest):
            return np.zeros(shown.shape[:-1], dtype=bool)
        return np.asarray((np.abs(shown @ self.rest.T) <= 1).all(axis=-1))

    def moved(self, y: Array, u: Array, origin: tuple[Array, Array] | None = None) -> Array:
        """Return what motion adds to the first estimate, shape (..., n)."""
        adds = (np.isfinite(y).all(axis=-1) & np.isfinite(u).all(axis=-1) & ~self.at_rest(y, u))[..., None]
        if origin is None:
            return np.asarray(np.where(adds, np.concatenate([y, u], axis=-1), 0.0) @ self.gain.T)
        at, along = origin[0][..., None], np.concatenate([[1.0], origin[1]])
        first = np.where(adds, np.concatenate([y, u], axis=-1) - at * along, 0.0)
        return np.asarray(first @ self.gain.T + np.where(adds, at, 0.0) * (self.gain @ along))

    def correction(self, since: npt.NDArray[np.int64], innovation: Array) -> Array:
        """Return what is added to the next estimate, shape (batch, n), `since` so many samples after the start, shape (batch,)."""
        at = np.minimum(since, len(self) - 1)
        return np.where((since < len(self))[:, None], np.einsum("bnq,bq->bn", self.corrections[at], innovation), 0.0)

    def times(self, x: Array, y: Array, u: Array) -> Start:
        """Return the start in other units of measure, by the factors of states, measurements and inputs."""
        both = np.concatenate([y, u])
        return Start(
            self.gain * x[:, None] / both,
            self.corrections * x[:, None] / y,
            self.rest / both if len(self.rest) else self.rest,
        )

    def turned(self, turn: Array) -> Start:
        """Return the start for states ``turn @ x``, shape (n', n)."""
        return Start(turn @ self.gain, turn @ self.corrections, self.rest)

    def content(self) -> dict[str, Any]:
        """Return what an observer's file holds of it."""
        return {name: getattr(self, name).tolist() for name in ("gain", "corrections", "rest")}
