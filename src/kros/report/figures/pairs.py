"""Shared by the figures of the paper's own pair of observers."""

from __future__ import annotations

from collections.abc import Iterable

from ..names import paper_pair
from ..run_folder import NotShownError

ABOUT_PAPER = "The paper's observers: mixed H2-H∞ synthesis, models of extended dynamic mode decomposition."


def require_paper_pair(names: Iterable[str]) -> list[str]:
    """Return the paper's linear and Koopman observer.

    Raises
    ------
    NotShownError
        Where the study made neither.
    """
    found = paper_pair(names)
    if not found:
        raise NotShownError(
            "this study has no observer of the paper's method; name mixed in synthesis.methods, and see why it failed where it did"
        )
    return found
