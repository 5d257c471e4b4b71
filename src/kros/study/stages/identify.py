"""Stage: models of every kind in every condition."""

from __future__ import annotations

from ...identify.identified import IdentifiedModels
from ...identify.identify import with_models
from ..engine.context import Context
from . import calibrate


def run(context: Context) -> None:
    """Identify and save."""
    base = IdentifiedModels(context.population, context.facts, context.lifting, calibrate.load(context))
    with_models(base, context.config.identify, context.work).save_models(context.store.draft())
