"""How figures look: size, type, and colours that have a light and a dark tone.

A figure is drawn in the light tones. In the report's inline SVG every tone becomes a CSS variable, so that the page can be light or dark.
Hues follow Okabe and Ito and stay apart for colour-blind readers; meaning is never carried by hue alone.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from enum import Enum
from typing import Any

WIDTH_IN = 7.4  # page width of every figure


class Tone(Enum):
    """A colour by what it is for: tone on light paper, tone on dark paper."""

    INK = ("#22262b", "#e6e9ec")
    SOFT = ("#5d656e", "#a5adb5")
    GRID = ("#dde1e5", "#363d44")
    BLUE = ("#0a69b4", "#58aef2")
    ORANGE = ("#d4520e", "#ff8c52")
    GREEN = ("#10826a", "#3ecaa6")
    PURPLE = ("#a44e90", "#e391cd")
    GOLD = ("#b98003", "#edb83c")
    SKY = ("#4d9fd6", "#8fccf3")
    GREY = ("#878f97", "#878f98")
    ALARM = ("#b3001f", "#ff6272")

    @property
    def light(self) -> str:
        """Tone on light paper, the one that figures are drawn in."""
        return str(self.value[0])

    @property
    def dark(self) -> str:
        """Tone on dark paper."""
        return str(self.value[1])

    @property
    def variable(self) -> str:
        """Name of the CSS variable."""
        return f"--{self.name.lower()}"


HUES = (Tone.BLUE, Tone.ORANGE, Tone.GREEN, Tone.PURPLE, Tone.GOLD, Tone.SKY, Tone.GREY, Tone.INK)

_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": Tone.INK.light,
    "axes.labelsize": 8.5,
    "axes.labelcolor": Tone.INK.light,
    "axes.edgecolor": Tone.SOFT.light,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.facecolor": "none",
    "grid.color": Tone.GRID.light,
    "grid.linewidth": 0.6,
    "text.color": Tone.INK.light,
    "xtick.color": Tone.SOFT.light,
    "ytick.color": Tone.SOFT.light,
    "xtick.labelcolor": Tone.INK.light,
    "ytick.labelcolor": Tone.INK.light,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "path.simplify_threshold": 0.3,
    "text.hinting": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "kros",
    "pdf.fonttype": 42,
}


def style() -> AbstractContextManager[None]:
    """Return a context in which new figures get this theme; settings of the caller come back afterwards."""
    import matplotlib

    context: AbstractContextManager[None] = matplotlib.rc_context(_SETTINGS)  # type: ignore[arg-type]
    return context
