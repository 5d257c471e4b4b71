"""What a further state of a weight buys: overbound over order, with what no system of that order can beat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ....uncertainty import UncertainModel
from ....uncertainty.fits.magnitude import Tightness
from ....uncertainty.weights.cover import Structure
from ...canvas import Axes, Figure, grid, legend
from ...names import model_label
from ...run_folder import RunFolder
from ...theme import Tone

_TOP_DB = 8.0


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a model."""
    models = {n: run.uncertain.get(n) for n in run.orders}
    tolerance = run.study.get("uncertainty", {}).get("tolerance_db")
    text = (
        "Disc: how far the best system of each order stays above the largest residual in its worst place, for one scalar magnitude. Bar: proven, no system "
        "of that order comes closer. Where both meet, the fit is the best there is and only a further state helps. Ring: the weights in use, at the largest "
        "order of an entry; diagonal ones are compared with the diagonal cover, by their mean."
    )
    text += f" Dashed: the tolerance of the study, {tolerance:g} dB." if tolerance is not None else ""
    return orders_figure(run.orders, models, tolerance), text


def orders_figure(
    found: Mapping[str, Tightness], models: Mapping[str, UncertainModel | None] | None = None, tolerance_db: float | None = None
) -> Figure:
    """Draw overbounds over orders, a panel a model; the weights of `models` are marked, and a tolerance."""
    figure, axes = grid(1, len(found), 1.9, sharey=True)
    top = min(_TOP_DB, 1.1 * max(float(one.overbound_db.max()) for one in found.values()) + 0.1)
    for panel, (name, one) in zip(axes[0], found.items(), strict=True):
        _panel(panel, one, (models or {}).get(name), tolerance_db)
        panel.set_title(model_label(name))
        panel.set_xlabel("order")
        panel.set_ylim(-0.02 * top, top)
    axes[0, 0].set_ylabel("overbound (dB)")
    legend(figure, axes[0, 0])
    return figure


def _panel(axes: Axes, found: Tightness, model: UncertainModel | None, tolerance_db: float | None) -> None:
    if tolerance_db is not None:
        axes.axhline(tolerance_db, color=Tone.SOFT.light, lw=0.8, ls="--")
    axes.plot(found.orders, found.overbound_db, "o-", color=Tone.BLUE.light, ms=4.5, lw=1.0, label="best fit of the order")
    axes.plot(found.orders, found.proven_db, "_", color=Tone.INK.light, ms=11, mew=1.8, label="proven lower bound")
    if model is not None and model.weight.structure in (Structure.SCALAR, Structure.DIAGONAL):
        order = max((*model.weight.left_orders, *model.weight.right_orders), default=0)
        ring: dict[str, Any] = {"ms": 9, "mfc": "none", "mec": Tone.ORANGE.light, "mew": 1.5, "zorder": 4}
        axes.plot(order, model.overbound_db_max, "o", label="weights in use", **ring)
    axes.set_xticks(found.orders)
    axes.set_xlim(found.orders[0] - 0.5, found.orders[-1] + 0.5)
