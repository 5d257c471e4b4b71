"""Estimates of the load torque."""

from __future__ import annotations

from ...data import Channel, Role
from ..canvas import Captioned
from ..names import in_condition, model_label, model_look
from ..run_folder import NotShownError, RunFolder, Shown
from .episodes import Block, blocks_figure

_WAYS = {"load": "load state", "current": "error of the recorded current"}


def load_torque(run: RunFolder) -> Captioned:
    """Draw estimates of the load on an episode, a row a way to estimate."""
    content, blocks = run.evaluation.get("load_torque"), list[Block]()
    if content is None:
        raise NotShownError("this study declares no load; set load.moment")
    shown = Shown.load(run.folder / "load")
    for way, label in _WAYS.items():
        estimates = {n: values for n, values in shown.observers.items() if n.endswith(f"/{way}")}
        lines = {model_label(n.partition("/")[0]): (values, model_look(n)) for n, values in estimates.items()}
        blocks += [Block(label, shown, lines, [0], "declared load")] if lines else []
    parts = [f"{r['observer']} {r['error_percent']:.0f} % of the load" for r in content["rows"]]
    text = f"Unit {shown.key.unit}{in_condition(shown.key.condition)}, in units of current. Errors below 5 Hz over all "
    text += f"units whose load was not known: {'; '.join(parts)}."
    return blocks_figure([Channel("load", Role.STATE)], blocks), text
