"""Stage: models of every kind in every condition."""

from __future__ import annotations

from ...identify.identify import identify
from ..engine.context import Context
from . import calibrate


def run(context: Context) -> None:
    """Identify and save."""
    found = identify(
        context.population,
        context.lifting,
        calibration=calibrate.load(context),
        facts=context.facts,
        work=context.work,
        **dict(context.config.identify),
    )
    found.save_models(context.store.draft())
