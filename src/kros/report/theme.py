"""How figures look: size, type, and colours that have a light and a dark tone.

A figure is drawn in the light tones; in the report's inline SVG every tone is a CSS variable, light or dark.
Hues follow Okabe and Ito and stay apart for colour-blind readers; meaning is never carried by hue alone.
"""

from contextlib import AbstractContextManager
from enum import StrEnum
from typing import Self

from ..core import frozen


@frozen
class Drawing:
    """How much is drawn; no number here changes a result."""

    width_in: float = 7.4  # of every figure
    row_in: float = 1.9  # height of a figure of one row
    more_rows_in: float = 1.0  # height of every further row
    legend_in: float = 0.2  # height of a row of a legend
    thin: float = 0.7  # points that lines beside others are wide
    broad: float = 2.8  # points that a line is wide which others are compared with
    shade: float = 0.35  # opacity of what lies behind
    dots_per_inch: int = 200
    frequencies: int = 140  # of a frequency response
    decades: int = 5  # below half of the sampling frequency
    states: int = 4  # rows of one episode or plant
    units: int = 400  # rows of the table of units
    label: int = 16  # characters of a name beside an axis
    zoom: float = 0.04  # share of an episode that is enlarged
    settled: float = 0.1  # share of an episode after which errors are drawn: at the start no observer knows the state
    diverged: float = 1e3  # ranges of the signal: a larger error is not drawn
    segment: int = 1024  # samples of a spectrum
    concentrated: float = 0.8  # concentration below which the segments of a unit disagree on its phase


DRAWING = Drawing()


class Tone(StrEnum):
    """A colour by what it is for: the tone on light paper, which figures are drawn in, and that on dark paper."""

    INK = "#22262b", "#e6e9ec"
    SOFT = "#5d656e", "#a5adb5"
    GRID = "#dde1e5", "#363d44"
    BLUE = "#0a69b4", "#58aef2"
    ORANGE = "#d4520e", "#ff8c52"
    GREEN = "#10826a", "#3ecaa6"
    PURPLE = "#a44e90", "#e391cd"
    GOLD = "#b98003", "#edb83c"
    SKY = "#4d9fd6", "#8fccf3"
    GREY = "#878f97", "#878f98"
    ALARM = "#b3001f", "#ff6272"

    dark: str

    def __new__(cls, light: str, dark: str) -> Self:
        """Return a member that is its light tone."""
        tone = str.__new__(cls, light)
        tone._value_, tone.dark = light, dark
        return tone

    @property
    def variable(self) -> str:
        """Name of the CSS variable."""
        return f"--{self.name.lower()}"


HUES = [Tone[name] for name in ["BLUE", "ORANGE", "GREEN", "PURPLE", "GOLD", "SKY", "GREY", "INK"]]

_SHEET = f"""
font.family: DejaVu Sans
font.size: 8.5
axes.titlesize: medium
axes.titleweight: bold
axes.titlelocation: left
axes.titlecolor: {Tone.INK}
axes.labelsize: medium
axes.labelcolor: {Tone.INK}
axes.edgecolor: {Tone.SOFT}
axes.linewidth: {DRAWING.thin}
axes.spines.top: False
axes.spines.right: False
axes.grid: True
axes.facecolor: none
grid.color: {Tone.GRID}
grid.linewidth: {DRAWING.thin}
text.color: {Tone.INK}
xtick.color: {Tone.SOFT}
ytick.color: {Tone.SOFT}
xtick.labelcolor: {Tone.INK}
ytick.labelcolor: {Tone.INK}
xtick.labelsize: small
ytick.labelsize: small
xtick.major.width: {DRAWING.thin}
ytick.major.width: {DRAWING.thin}
lines.linewidth: 1.2
legend.frameon: False
legend.fontsize: 8
path.simplify_threshold: 0.3
text.hinting: none
svg.fonttype: none
svg.hashsalt: kros
pdf.fonttype: 42
"""


def style() -> AbstractContextManager[None]:
    """Return a context in which new figures get this theme; settings of the caller come back afterwards."""
    import matplotlib

    return matplotlib.rc_context(dict(row.split(": ") for row in _SHEET.split("\n") if row))  # type: ignore[arg-type]
