"""What cross-validation found, and the choice made from it: which lifting, how much regularisation.

candidates x alphas x folds x units --> scores of episodes that the model has not seen --> the best, or the simplest as good as the best
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, IdentificationError
from .scores import Horizon, weighted_mean

Array = npt.NDArray[np.float64]


class LeaveOut(str, Enum):
    """What a model has not seen when it is scored."""

    EPISODES = "episodes"
    UNITS = "units"


@dataclass(frozen=True)
class Choice:
    """What was chosen, and how clearly.

    Parameters
    ----------
    candidate : str
    alpha : float
    value : float
        Of the criterion; smaller is better (for ``r2`` it is ``1 - R^2``).
    best_value : float
        The smallest value of all; that of the choice itself but for the one-standard-error rule.
    standard_error : float
        Of the smallest value; over units, or over folds where there is one unit; nan for one unit and one fold.
    """

    candidate: str
    alpha: float
    value: float
    best_value: float
    standard_error: float


@dataclass(frozen=True, eq=False)
class Selection:
    """Scores of all candidates, each on recordings that its model has not seen.

    Parameters
    ----------
    leave_out : LeaveOut
    candidates : tuple of str
    n_lifted : tuple of int
        Lifted states of every candidate.
    alphas : tuple of float
    unit_ids : tuple of str
    states : tuple of str
    horizons : tuple of int or None
        Samples ahead; None stands for the whole free run.
    scored : ndarray of bool, shape (fold, unit)
        Whether the fold holds episodes of the unit.
    percent, rms, r2 : ndarray, shape (candidate, alpha, fold, unit, horizon, state)
        Mean over the unit's episodes in the fold; nan where there is none, or none long enough. Infinite errors where a run diverged, or
        where no model could be made.
    spectral_radius : ndarray, shape (candidate, alpha, fold, unit)
        Of the model that was scored.
    """

    leave_out: LeaveOut
    candidates: tuple[str, ...]
    n_lifted: tuple[int, ...]
    alphas: tuple[float, ...]
    unit_ids: tuple[str, ...]
    states: tuple[str, ...]
    horizons: tuple[Horizon, ...]
    scored: npt.NDArray[np.bool_]
    percent: Array
    rms: Array
    r2: Array
    spectral_radius: Array

    def values(self, measure: str = "percent", horizon: Horizon = None, state_weights: npt.ArrayLike | None = None) -> Array:
        """Return a loss, smaller is better, by candidate, alpha, fold and unit.

        Parameters
        ----------
        measure : str
            ``percent``, ``rms``, or ``r2`` (the loss is then ``1 - R^2``).
        horizon : int or None
            One of `horizons`.
        state_weights : array_like, shape (n,), optional
            Equal by default.

        Raises
        ------
        ConfigError
            When the measure or the horizon was not computed.
        """
        if measure not in ("percent", "rms", "r2") or horizon not in self.horizons:
            raise ConfigError(
                f"Selection: asked for {measure!r} at horizon {horizon}; there are percent, rms and r2 at horizons {self.horizons}."
            )
        weights = np.ones(len(self.states)) if state_weights is None else state_weights
        found = weighted_mean(getattr(self, measure)[..., self.horizons.index(horizon), :], weights)
        return 1 - found if measure == "r2" else found

    def best(
        self,
        measure: str = "percent",
        horizon: Horizon = None,
        state_weights: npt.ArrayLike | None = None,
        units: str = "mean",
        one_standard_error: bool = False,
    ) -> Choice:
        """Return the candidate and alpha of the smallest loss, or the simplest that is as good.

        Parameters
        ----------
        measure, horizon, state_weights
            The loss, as in `values`: mean over folds, then over units.
        units : str
            ``mean``, ``median`` or ``worst`` over units.
        one_standard_error : bool
            Take the simplest pair whose loss does not exceed the smallest by more than its standard error: fewest lifted states first,
            then the largest alpha (Breiman, Friedman, Olshen and Stone, *Classification and Regression Trees*, 1984, section 3.4.3).

        Returns
        -------
        Choice
            Equal losses are settled towards the simpler pair, then by name.

        Raises
        ------
        ConfigError
            When the criterion is unknown.
        IdentificationError
            When no pair has a finite loss.
        """
        if units not in ("mean", "median", "worst") or (one_standard_error and units != "mean"):
            raise ConfigError(
                f"Selection: units = {units!r} with one_standard_error = {one_standard_error}; use mean, median or worst, and mean for the rule."
            )
        cells = self.values(measure, horizon, state_weights)
        by_unit = _mean(cells, axis=2)  # (candidate, alpha, unit)
        with np.errstate(invalid="ignore"):
            loss = {"mean": by_unit.mean(axis=-1), "median": np.median(by_unit, axis=-1), "worst": by_unit.max(axis=-1)}[units]
        loss = np.where(np.isfinite(loss), loss, np.inf)
        simple = sorted(np.ndindex(loss.shape), key=lambda at: (self.n_lifted[at[0]], -self.alphas[at[1]], self.candidates[at[0]]))
        top = min(simple, key=lambda at: loss[at])  # the first of equals
        if not np.isfinite(loss[top]):
            raise IdentificationError(
                f"Selection: no candidate of {self.candidates} has a finite {measure} at horizon {'free run' if horizon is None else horizon}; "
                "add larger alphas, shorter horizons, or weights that leave out constant states."
            )
        groups = by_unit[top] if by_unit.shape[-1] > 1 else cells[top][:, 0]
        groups = groups[~np.isnan(groups)]
        error = float(np.std(groups, ddof=1) / np.sqrt(len(groups))) if len(groups) > 1 else float("nan")
        limit = loss[top] + (error if one_standard_error and np.isfinite(error) else 0.0)
        chosen = next(at for at in simple if loss[at] <= limit) if one_standard_error else top
        return Choice(self.candidates[chosen[0]], self.alphas[chosen[1]], float(loss[chosen]), float(loss[top]), error)

    def as_rows(self) -> list[dict[str, Any]]:
        """Return one record for every candidate, alpha, fold, unit, horizon and state that was scored."""
        return list(self._rows())

    def _rows(self) -> Iterator[dict[str, Any]]:
        for c, a in np.ndindex(len(self.candidates), len(self.alphas)):
            for f, u in np.argwhere(self.scored):
                for h, s in np.ndindex(len(self.horizons), len(self.states)):
                    at = (c, a, f, u, h, s)
                    horizon = self.horizons[h]
                    yield {
                        "leave_out": self.leave_out.value,
                        "candidate": self.candidates[c],
                        "n_lifted": self.n_lifted[c],
                        "alpha": self.alphas[a],
                        "fold": int(f),
                        "unit": self.unit_ids[u],
                        "horizon": "free_run" if horizon is None else horizon,
                        "state": self.states[s],
                        "percent": float(self.percent[at]),
                        "rms": float(self.rms[at]),
                        "r2": float(self.r2[at]),
                        "spectral_radius": float(self.spectral_radius[at[:4]]),
                    }


def _mean(values: Array, axis: int) -> Array:
    """Mean over what is not nan; nan where all is."""
    known = ~np.isnan(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)
