"""Any figure of a finished run, by name. For plots of results in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from ...core.errors import ConfigError
from ..canvas import Figure
from ..run_folder import RunFolder
from . import FIGURES, draw


class Run(Protocol):
    """What a run leaves behind."""

    @property
    def folder(self) -> Path:
        """Its folder."""
        ...


def run_figure(run: Run, name: str = "observers_in_time") -> Figure:
    """Draw one figure of a run, by default the estimates of the deployed observer."""
    if name not in FIGURES:
        raise ConfigError(f"Plot of a run: there is no figure {name!r}; choose one of {', '.join(FIGURES)}.")
    drawn = draw(name, RunFolder(run.folder))
    if drawn.figure is None:
        raise ConfigError(f"Plot of a run: the figure {name!r} is left out, {drawn.reason}.")
    return drawn.figure
