r"""Residuals of every unit beside weights, in both readings: entry by entry as in the paper's figures, and as a cover.

    |E_ij|                       against  |W_ij|, the best fit to the largest of the covered units    entrywise
    sigma_max(W_L^-1 E W_R^-1)   against  one                                                         sound

Nothing here decides anything: it is what pictures of an uncertain model and of an outlier show. A unit that the weights
were not made for exceeds one where it sticks out.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import check_shapes, load_artifact, loader, save_artifact
from ..core.errors import DimensionError
from .forms import Form, residual
from .weights.cover import Cover, cover_ratio
from .weights.magnitude import fit_magnitude
from .weights.weight import EntrywiseWeight, Weight, unstructured_excess

Array = npt.NDArray[Any]

MOST_UNITS = 200  # that are kept for a picture
_ARRAYS = ("freqs_hz", "entries", "ratio", "largest", "entry_weights", "entry_orders")


@dataclass(frozen=True, eq=False)
class UnitResiduals:
    """Sizes of the residuals of many units against one nominal."""

    form: Form
    nominal_id: str
    unit_ids: tuple[str, ...]  # units that are kept, at most 200 of those covered, and all others
    outside: tuple[str, ...]  # units that the weights do not have to cover
    freqs_hz: Array  # (frequency,), Hz
    entries: Array  # (unit, frequency, p', m'): magnitudes of the residual's entries, in scaled coordinates
    ratio: Array  # (unit, frequency): ``sigma_max(W_L^-1 E W_R^-1)``
    largest: Array  # (frequency, p', m'): largest entries of all covered units
    entry_weights: Array  # (frequency, p', m')
    entry_orders: Array  # (p', m')
    entry_excess: float = float("nan")

    def rows(self, *, inside: bool) -> list[int]:
        """Return rows of the units that are covered, or of those that need not be."""
        return [k for k, unit in enumerate(self.unit_ids) if (unit not in self.outside) is inside]

    def save(self, folder: Path) -> None:
        """Write ``arrays.npz`` and ``unit_residuals.json``."""
        content = {name: getattr(self, name) for name in ("form", "nominal_id", "unit_ids", "outside", "entry_excess")}
        save_artifact(Path(folder), "unit_residuals", content, {name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    @loader
    def load(cls, folder: Path) -> UnitResiduals:
        """Read what `save` wrote."""
        content, arrays = load_artifact(Path(folder), "unit_residuals")
        axes = {
            "freqs_hz": "f",
            "entries": "ufpm",
            "ratio": "uf",
            "largest": "fpm",
            "entry_weights": "fpm",
            "entry_orders": "pm",
        }
        check_shapes(arrays, axes, {"u": len(content["unit_ids"])}, Path(folder))
        return cls(
            form=Form(content["form"]),
            nominal_id=content["nominal_id"],
            unit_ids=tuple(content["unit_ids"]),
            outside=tuple(content["outside"]),
            entry_excess=float("nan") if content["entry_excess"] is None else content["entry_excess"],
            **{name: arrays[name] for name in _ARRAYS},
        )


def unit_residuals(
    form: Form,
    nominal: Array,
    responses: Array,
    weights: Weight | Cover,
    freqs_hz: Array,
    sample_period_s: float,
    *,
    unit_ids: Sequence[str],
    nominal_id: str,
    outside: Collection[str] = (),
    max_order: int = 4,
    tolerance_db: float = 1.0,
) -> UnitResiduals:
    """Return residuals of units against a nominal, of shape (unit, frequency, p, m), beside weights or a cover."""
    inside = np.array([u not in outside for u in unit_ids], dtype=bool)
    if len(unit_ids) != len(responses) or not inside.any():
        raise DimensionError(
            f"Residuals of units: need a name for each of {len(responses)} responses and at least one unit that "
            f"is covered, "
            f"found {len(unit_ids)} names, {int(inside.sum())} of them covered."
        )
    E = residual(form, nominal, responses)
    sizes, ratio = np.abs(E), weight_ratio(weights, E, freqs_hz)
    largest = sizes[inside].max(axis=0)
    fitted, orders = np.empty_like(largest, dtype=complex), np.zeros(largest.shape[1:], dtype=int)
    for i, j in np.ndindex(*largest.shape[1:]):
        found = fit_magnitude(
            freqs_hz, largest[:, i, j], sample_period_s, max_order=max_order, tolerance_db=tolerance_db
        )
        fitted[:, i, j] = found.system.frequency_response(freqs_hz)[:, 0, 0]
        orders[i, j] = found.order
    kept = shown_rows(inside)
    return UnitResiduals(
        form=form,
        nominal_id=nominal_id,
        unit_ids=tuple(unit_ids[k] for k in kept),
        outside=tuple(u for u in unit_ids if u in outside),
        freqs_hz=freqs_hz,
        entries=sizes[kept],
        ratio=ratio[kept],
        largest=largest,
        entry_weights=np.abs(fitted),
        entry_orders=orders,
        entry_excess=unstructured_excess(fitted, E[inside]),
    )


def weight_ratio(weights: Weight | Cover, E: Array, freqs_hz: Array) -> Array:
    """Return ``sigma_max(W_L^-1 E W_R^-1)``, shape (unit, frequency)."""
    if isinstance(weights, EntrywiseWeight):
        size = np.abs(weights.matrix().frequency_response(freqs_hz))
        return np.asarray(np.divide(np.abs(E), size, out=np.zeros(E.shape), where=size > 0).max(axis=(-2, -1)))
    cover = weights.magnitudes(freqs_hz) if isinstance(weights, Weight) else weights
    return cover_ratio(E, cover.left, cover.right)


def shown_rows(inside: npt.NDArray[np.bool_]) -> Array:
    """Return at most 200 rows of covered units, evenly spread, and all others."""
    rows = np.flatnonzero(inside)
    some = rows[np.unique(np.linspace(0, len(rows) - 1, min(MOST_UNITS, len(rows))).round().astype(int))]
    return np.sort(np.concatenate([some, np.flatnonzero(~inside)]))
