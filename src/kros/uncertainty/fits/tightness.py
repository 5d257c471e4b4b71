"""Order against tightness: what a further state of a weight buys."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import load_artifact, save_artifact
from ...core.loading import loader
from .magnitude import _FLOOR, FittedMagnitude, Side, _Problem, fit_magnitude

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Tightness:
    """Overbounds over orders.

    Parameters
    ----------
    orders : ndarray of int, shape (n_orders,)
    overbound_db : ndarray, shape (n_orders,), dB
    proven_db : ndarray, shape (n_orders,), dB
        What no fit of that order goes below (magnitudes); zero where nothing is proven.
    states : ndarray of int, shape (n_orders,)
    """

    orders: Array
    overbound_db: Array
    proven_db: Array
    states: Array

    def save(self, folder: Path) -> None:
        """Write ``tightness.json``."""
        save_artifact(Path(folder), "tightness", vars(self))

    @classmethod
    @loader
    def load(cls, folder: Path) -> Tightness:
        """Read what `save` wrote."""
        content, _ = load_artifact(Path(folder), "tightness")
        return cls(**{f.name: np.array(content[f.name]) for f in fields(cls)})


def magnitude_tightness(
    freqs_hz: npt.ArrayLike, magnitude: npt.ArrayLike, sample_period_s: float, orders: Iterable[int] = range(1, 9)
) -> Tightness:
    """Return the overbound of the best fit of each order to one magnitude, each fit started from the one an order lower.

    Orders, or a magnitude, that cannot be fitted are refused as by `fit_magnitude`. A system of lower order counts as one of every higher order.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty.fits.tightness import magnitude_tightness
    >>> freqs = np.geomspace(1e-3, 500.0, 200)
    >>> curve = magnitude_tightness(freqs, 1 / np.hypot(1.0, freqs / 3.0) + 0.01, 1e-3, range(1, 4))
    >>> bool(curve.overbound_db[-1] < curve.overbound_db[0])
    True
    """
    chosen = np.array(list(orders), int)
    fits = _fit_orders(freqs_hz, magnitude, sample_period_s, int(chosen.max(initial=0)))
    best = [min((f for f in fits if f.order <= n), key=lambda f: f.overbound_db) for n in chosen]
    proven = [max((f.proven_db for f in fits if f.order >= n), default=0.0) for n in chosen]  # of an order, hence of every lower one
    return Tightness(chosen, np.array([f.overbound_db for f in best]), np.array(proven), np.array([f.order for f in best]))


def _fit_orders(freqs_hz: npt.ArrayLike, magnitude: npt.ArrayLike, sample_period_s: float, highest: int) -> list[FittedMagnitude]:
    """Fits of order 0, 1, ..., each started from the one before; fewer where programs fail."""
    constant = fit_magnitude(freqs_hz, magnitude, sample_period_s, order=0)
    if constant.overbound_db == 0:
        return [constant]
    freqs, values = np.asarray(freqs_hz, float), np.asarray(magnitude, float)
    problem = _Problem(freqs, np.maximum(values, _FLOOR * values.max()), sample_period_s, Side.ABOVE)
    found, lower = [constant], None
    for order in range(highest + 1):
        fit, lower = problem.fit(order, 0.0, lower, last=True)
        found += [fit] if fit is not None and order > 0 else []
    return found
