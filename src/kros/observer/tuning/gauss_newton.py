"""Damped Gauss-Newton steps (Levenberg and Marquardt) to smaller errors of the hidden states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SETTLED = (
    3  # error dynamics forget within this part of an episode: what is slower, recordings of this length cannot judge
)
_TINY = np.finfo(float).tiny


class Point(Protocol):
    """What is tuned, with the criterion that it reaches; infinite where it is not allowed."""

    @property
    def criterion(self) -> float:
        """Weighted mean of the logarithms of the root mean square errors."""


P = TypeVar("P", bound=Point)


@dataclass(frozen=True)
class Damping:
    """Least, first and largest damping of scaled coefficients, and by what it grows when a step does not help."""

    least: float
    first: float
    largest: float
    growth: float


def search(
    point: P,
    steps: Callable[[P], Callable[[float], P]],
    damping: Damping,
    iterations: int,
    least_gain: float,
    patience: int = 1,
) -> tuple[P, tuple[float, ...]]:
    """Return the best point, and the criterion before the search and after every step."""
    criterion, level = [point.criterion], damping.first
    for _ in range(iterations):
        trial_at = steps(point)
        while level <= damping.largest:
            trial = trial_at(level)
            if trial.criterion < criterion[-1]:
                break
            level *= damping.growth
        else:
            break
        point, level = trial, max(level / 10, damping.least)
        criterion.append(point.criterion)
        if len(criterion) > patience and criterion[-1 - patience] - criterion[-1] < least_gain:
            break
    return point, tuple(criterion)


def mean_log(share: Array, mean_squares: Array) -> float:
    """Return the criterion of mean square errors, shape (h,); infinite where an estimate diverges."""
    return float(share @ np.log(mean_squares) / 2) if np.isfinite(mean_squares).all() else np.inf


def scaled(matrix: Array, right: Array) -> tuple[Array, Array, Array]:
    """Return normal equations for coefficients divided by their sizes, and these sizes."""
    size = np.sqrt(np.maximum(np.diag(matrix), _TINY))
    return matrix / np.outer(size, size), right / size, size


def whitening(moments: Array, alike: float) -> Array:
    """Return T with ``T' moments T`` the identity, of full column rank where moments lack some; `alike` is the share at which rounding decides."""
    size = np.sqrt(np.maximum(np.diag(moments), _TINY))
    values, vectors = np.linalg.eigh(moments / np.outer(size, size))
    kept = values > alike * values[-1]
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]) / size[:, None])
