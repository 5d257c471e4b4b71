"""Order against tightness: what a further state of a weight buys."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .cover import Structure
from .fit import fit_magnitude
from .weights import Residuals, fit_weight

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Tightness:
    """Overbounds over orders.

    Parameters
    ----------
    orders : ndarray of int, shape (n_orders,)
        Of a magnitude, or the largest of one entry of a weight.
    overbound_db : ndarray, shape (n_orders,), dB
    proven_db : ndarray, shape (n_orders,), dB
        What no fit of that order goes below (magnitudes); zero where nothing is proven.
    states : ndarray of int, shape (n_orders,)
        Of all entries together.
    """

    orders: Array
    overbound_db: Array
    proven_db: Array
    states: Array


def magnitude_tightness(
    freqs_hz: npt.ArrayLike, magnitude: npt.ArrayLike, sample_period_s: float, orders: Iterable[int] = range(1, 9)
) -> Tightness:
    """Return the overbound of the best fit of each order to one magnitude.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty.tightness import magnitude_tightness
    >>> freqs = np.geomspace(1e-3, 500.0, 200)
    >>> curve = magnitude_tightness(freqs, 1 / np.hypot(1.0, freqs / 3.0) + 0.01, 1e-3, range(1, 4))
    >>> bool(curve.overbound_db[-1] < curve.overbound_db[0])
    True
    """
    chosen = np.array(list(orders), int)
    fits = [fit_magnitude(freqs_hz, magnitude, sample_period_s, order=int(n)) for n in chosen]
    return Tightness(
        chosen, np.array([f.overbound_db for f in fits]), np.array([f.proven_db for f in fits]), np.array([f.order for f in fits])
    )


def weight_tightness(
    residuals: Residuals,
    freqs_hz: Array,
    sample_period_s: float,
    orders: Iterable[int] = range(1, 9),
    *,
    structure: Structure | str = Structure.DIAGONAL,
    density: int = 10,
) -> Tightness:
    """Return the overbound of weights whose entries have at most each order; nothing is proven about the best ones."""
    chosen = np.array(list(orders), int)
    options: dict[str, Any] = {"structure": structure, "tolerance_db": 0.0, "density": density}
    found = [fit_weight(residuals, freqs_hz, sample_period_s, max_order=int(n), **options)[0] for n in chosen]
    states = np.array([sum(w.left_orders) + sum(w.right_orders) for w in found])
    return Tightness(chosen, np.array([w.overbound_db_max for w in found]), np.zeros(len(chosen)), states)
