r"""Models along recordings that start in motion: what was before is not known, so the first states are whatever fits the hidden states best.

From another start estimates differ by ``H F^k d``. Here d, one for every episode, is the least squares solution (variable projection): what is left
is the error of the model, and not of a start that no recording says.

References
----------
G. H. Golub and V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate", SIAM J. Numer.
Anal. 10 (1973) 413-432; L. Kaufman, "A variable projection method for solving separable nonlinear least squares problems", BIT 15 (1975) 49-57.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_AT_REST = 0.05  # of the root mean square
_ALIKE = 1e-9


def in_motion(truth: Array) -> bool:
    """Whether recordings of hidden states, shape (n_samples, batch, h), begin while machines move: no state is near zero then."""
    power = np.mean(truth**2, axis=1)
    return bool(np.all(power[0] > _AT_REST**2 * power.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class FreeStart:
    """What a start of its own does to the estimates of every episode."""

    powers: Array  # (n_samples, n, n): `F^k`
    seen: Array  # (h, n_samples, n): `H F^k`
    weights: Array  # (h,): of the squares of the hidden states' errors

    @classmethod
    def of(cls, F: Array, H: Array, n_samples: int, weights: Array) -> FreeStart:
        """Look at a model."""
        powers = np.eye(len(F))[None]
        while len(powers) < n_samples:
            powers = np.concatenate([powers, powers @ (powers[-1] @ F)])
        return cls(powers[:n_samples], np.einsum("hn,knm->hkm", H, powers[:n_samples]), weights)

    @staticmethod
    def by_size(missed: Array) -> Array:
        """Return weights by which errors, shape (h, batch, n_samples), are of one size."""
        return np.asarray(1 / np.maximum(np.mean(missed**2, axis=(1, 2)), np.finfo(float).tiny))

    @cached_property
    def _inverse(self) -> Array:
        return self._inverted(1)

    def _inverted(self, every: int) -> Array:
        """From weighted errors to starts, shape (n, h * n_samples / every)."""
        rows = self.seen[:, ::every] * np.sqrt(self.weights)[:, None, None]
        return np.asarray(np.linalg.pinv(rows.reshape(-1, rows.shape[-1]), rcond=_ALIKE))

    def fitted(self, missed: Array, every: int = 1) -> Array:
        """Return the starts d, shape (n, ..., batch), that take the most from errors, shape (..., h, batch, n_samples / every)."""
        weighted = np.moveaxis(missed * np.sqrt(self.weights)[:, None, None], -3, -2)
        inverse = self._inverse if every == 1 else self._inverted(every)
        return np.asarray(np.moveaxis(weighted.reshape(*weighted.shape[:-2], -1) @ inverse.T, -1, 0))

    def without(self, missed: Array, every: int = 1) -> Array:
        """Return what the best starts leave of errors, of the same shape."""
        left = missed - np.einsum("hkn,n...b->...hbk", self.seen[:, ::every], self.fitted(missed, every), optimize=True)
        return np.asarray(left)

    def back(self, weighted: Array) -> Array:
        """Return what `without`, transposed, makes of errors, shape (h, batch, n_samples): their products with all that starts can do become zero."""
        inverse = self._inverse.reshape(-1, *self.seen.shape[:2]) * np.sqrt(self.weights)[:, None]
        felt = np.einsum("hkn,hbk->nb", self.seen, weighted, optimize=True)
        return np.asarray(weighted - np.einsum("nhk,nb->hbk", inverse, felt, optimize=True))

    def moved(self, starts: Array, every: int = 1) -> Array:
        """Return what starts d, shape (n, batch), add to the states, shape (n, batch, n_samples / every)."""
        return np.asarray(np.einsum("knm,mb->nbk", self.powers[::every], starts, optimize=True))
