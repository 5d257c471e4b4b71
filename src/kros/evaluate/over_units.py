"""What errors of some units say about all units, and about the next one.

How sure a mean error is: bootstrap over units, not samples, since units are what differs (B. Efron and R. J.
Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, chapter 13).

The next unit, by split conformal prediction: of ``n`` units that nothing was made from, and one more that is
exchangeable with them, every order of their errors is equally likely. So the error of the next unit is at most the
``ceil(confidence (n + 1))``-th smallest of theirs with a probability of at least ``confidence``, whatever their
distribution, the observer or the plant. Several errors are bounded together by the largest one relative to a scale that
was fixed before (V. Vovk, A. Gammerman and G. Shafer, Algorithmic Learning in a Random World, Springer 2005, section
4.2; H. Papadopoulos et al., Inductive Confidence Machines for Regression, ECML 2002).
"""

from collections.abc import Sequence
from math import ceil
from operator import itemgetter

import numpy as np

from ..core import ITERATED, Array, ArrayLike, ByName, DataError, Names, Record, grouped

_CELL = ("observer", "condition", "channel")


def unit_interval(values: ArrayLike, draws: int = 4000, seed: int = 0) -> tuple[Array, Array]:
    """Return the 95 % percentile bootstrap interval of the mean over units.

    Parameters
    ----------
    values : array_like, shape (unit, ...)
        One number a unit, such as its mean error.
    draws, seed : int

    Returns
    -------
    lower, upper : ndarray, shape (...)

    Raises
    ------
    DataError
        With fewer than two units, where nothing can be resampled.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import unit_interval
    >>> lower, upper = unit_interval(np.linspace(1.0, 2.0, 20))
    >>> bool(lower < 1.5 < upper)
    True
    """
    from scipy.stats import bootstrap

    values = np.asarray(values, dtype=float)
    if values.ndim < 1 or len(values) < 2:
        raise DataError(f"Bootstrap over units: needs at least 2 units, found values of shape {values.shape}.")
    rng = np.random.default_rng(seed)
    result = bootstrap((values,), np.mean, n_resamples=draws, method="percentile", rng=rng)
    return result.confidence_interval.low, result.confidence_interval.high


def interval_rows(rows: Sequence[ByName]) -> list[Record]:
    """Return the 95 % ``interval`` of the mean error over at least three units, by observer, condition and channel."""
    intervals = []
    for cell, of in grouped((row for row in rows if row["role"] == "off_nominal"), itemgetter(*_CELL)).items():
        values = np.array([row["error_percent"] for row in sorted(of, key=itemgetter("unit"))], float)  # unknown is NaN
        if len(values) > 2 and np.isfinite(values).all():
            interval = [float(end) for end in unit_interval(values)]
            intervals.append({**dict(zip(_CELL, cell, strict=True)), "role": "off_nominal", "interval": interval})
    return intervals


def draw_reserve(units: Sequence[str], n: int, seed: int = 0) -> Names:
    """Draw units that take part in nothing, by place alone; more of them include fewer."""
    drawn = np.random.default_rng(seed).permutation(len(units))[:n]
    return tuple(units[i] for i in sorted(drawn))


def fewest_units(confidence: float) -> int:
    """Return how many units bound the next one: ``1 / (1 - confidence) - 1``, rounded up."""
    return ceil(confidence / (1 - confidence) - ITERATED)  # 0.9 / (1 - 0.9) is a little more than 9


def next_unit_bound(errors: ArrayLike, scale: ArrayLike, confidence: float = 0.95) -> Array | None:
    """Bound the errors of the next unit, (k,), all of them together; None with fewer units than `fewest_units`."""
    errors, scale = np.asarray(errors, dtype=float), np.asarray(scale, dtype=float)
    if len(errors) < fewest_units(confidence):
        return None
    scores = np.max(np.where(np.isfinite(errors), errors, np.inf) / scale, axis=1)
    rank = ceil(confidence * (len(errors) + 1) - ITERATED)
    return np.sort(scores)[rank - 1] * scale
