"""Stage: how units differ, and what the report tells beside it."""

from __future__ import annotations

from ...uncertainty.quantify import quantify
from ..engine.context import Context
from .diagnose import diagnose


def run(context: Context) -> None:
    """Quantify and save."""
    found = quantify(context.identified, work=context.work, **dict(context.config.uncertainty))
    found.save_sets(context.store.draft())
    diagnose(context, found)
