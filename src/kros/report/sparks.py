"""Small pictures of one unit, written by hand: there is one for every unit, and a plotting library would take a second for each."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from .canvas import Array, log_ticks, thin
from .names import number
from .theme import Tone

_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 380, 120, 52, 18, 18
_BUCKETS = 90

Line = tuple[Array, Tone, float]


def spark(title: str, x: Array, lines: Sequence[Line], unit: str, logarithmic: bool = False) -> str:
    """Return an inline SVG of lines over time or frequency, numbered at the ends of its axes."""
    at = np.log10(x) if logarithmic else x
    finite = np.concatenate([values[np.isfinite(values)] for values, _, _ in lines])
    if not finite.size or at[-1] <= at[0]:
        return ""
    low, high = float(finite.min()), float(finite.max())
    room = (high - low or abs(high) or 1.0) * 0.04
    low, high = low - room, high + room

    def across(values: Array) -> Array:
        return np.asarray(_LEFT + (values - at[0]) / (at[-1] - at[0]) * (_WIDTH - _LEFT - 4))

    def down(values: Array) -> Array:
        return np.asarray(_TOP + (high - values) / (high - low) * (_HEIGHT - _TOP - _BOTTOM))

    def text(place: tuple[float, float], anchor: str, words: str) -> str:
        return f'<text x="{place[0]:.0f}" y="{place[1]:.0f}" text-anchor="{anchor}">{escape(words)}</text>'

    drawn = []
    for values, tone, width in lines:
        kept = np.isfinite(values)
        points = thin(at[kept], values[kept], _BUCKETS)
        path = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(across(points[0]), down(points[1]), strict=True))
        drawn.append(f'<path d="M{path}" stroke="var({tone.variable})" stroke-width="{width:g}"/>')
    ticks = log_ticks(float(x[0]), float(x[-1])) if logarithmic else [float(x[0]), float(x[-1])]
    places = across(np.log10(ticks) if logarithmic else np.array(ticks))
    marks = [text((place, _HEIGHT - 4), "middle", number(t, 2)) for place, t in zip(places[:-1], ticks[:-1], strict=True)]
    marks.append(text((places[-1], _HEIGHT - 4), "middle" if logarithmic else "end", f"{number(ticks[-1], 2)} {unit}"))
    ends = ((_TOP + 6, high - room), (_HEIGHT - _BOTTOM, low + room))
    marks += [text((_LEFT - 5, y), "end", number(v if abs(v) > 0.2 * room else 0.0, 2)) for y, v in ends]
    zero = f'<path d="M{_LEFT} {float(down(np.asarray(0.0))):.1f}H{_WIDTH - 4}" class="zero"/>' if low < 0 < high else ""
    opening = f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">'
    return "".join([opening, zero, *drawn, text((_LEFT, 12), "start", title), *marks, "</svg>"])
