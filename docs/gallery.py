"""Figures of notebooks for sphinx-gallery: a figure that the last line of a cell returns, as the method `plot` of results does, which pyplot does not know."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

DOTS_PER_INCH = 160


def returned_figure(_block: tuple[Any, ...], variables: dict[str, Any], settings: dict[str, Any]) -> str:
    """Write the figure that a cell returned, and return the reStructuredText that shows it."""
    known = variables["example_globals"]
    figure = known.get("___")  # what sphinx-gallery calls the value of the cell's last line
    if not isinstance(figure, Figure):
        return ""
    known["___"] = None  # shown once
    path = next(variables["image_path_iterator"])
    figure.savefig(path, dpi=DOTS_PER_INCH)
    shown: str = figure_rst([path], settings["src_dir"])
    return shown


def _get_sg_image_scraper() -> Callable[..., str]:
    """Return what sphinx-gallery asks a scraper's module for."""
    return returned_figure
