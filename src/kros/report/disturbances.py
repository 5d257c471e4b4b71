"""Errors against severity: curves from the rows of the metrics, titles of their axes, which observers are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..evaluate import Kind
from .names import Look, number, split_observer
from .theme import Tone

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """Axis of the severities of one kind: title, factor from the metrics' unit, whether it is logarithmic."""

    title: str
    factor: float = 1.0
    logarithmic: bool = True


AXES = {
    Kind.DROPPED: Axis("dropouts (% of the samples)", 100.0, logarithmic=False),
    Kind.GAP: Axis("gap length (ms)", 1e3),
    Kind.BIAS: Axis("bias (% of the largest value)", 100.0),
    Kind.QUANTISATION: Axis("resolution (% of the largest value)", 100.0),
    Kind.NOISE: Axis("noise (% of the largest value)", 100.0),
    Kind.PHASE: Axis("phase error (rad)", logarithmic=False),
    Kind.DELAY: Axis("delay (samples)"),
}
_LEFT_OUT = ("kalman_white", "luenberger")
_LOOKS = {
    "worst_case_h2": Look(Tone.BLUE.light),
    "worst_case_hinf": Look(Tone.BLUE.light, "--"),
    "residual_h2": Look(Tone.INK.light),
    "memory": Look(Tone.SKY.light),
    "mixed": Look(Tone.ORANGE.light),
    "open_loop": Look(Tone.GREY.light),
    "kalman_tuned": Look(Tone.PURPLE.light, "--"),
    "ekf": Look(Tone.PURPLE.light),
    "filtered_difference": Look(Tone.GOLD.light),
    "learned": Look(Tone.GREEN.light),
}


class Curve(NamedTuple):
    """Mean error of one observer in one channel, percent of the largest value, against the severity of one disturbance.

    Both have shape (k,); the first severity is zero, and an error is infinite where an estimate diverged.
    """

    severities: Array
    errors: Array


Curves = dict[str, dict[Kind, dict[str, Curve]]]


def curves(rows: Sequence[Mapping[str, Any]], condition: str, what: str = "mean") -> Curves:
    """Return curves by observer, kind and channel, from ``robustness`` of the metrics; `what` of the units, ``mean`` or ``worst``."""
    plain: dict[tuple[str, str], float] = {}
    points: dict[tuple[str, Kind, str], list[tuple[float, float]]] = {}
    for row in rows:
        if row["condition"] != condition:
            continue
        value, observer, channel = row["error_percent"][what], row["observer"], row["channel"]
        error = np.inf if value is None else float(value)
        if row["disturbance"] == "none":
            plain[observer, channel] = error
        else:
            start = [(0.0, plain[observer, channel])]
            points.setdefault((observer, Kind(row["disturbance"]), channel), start).append((row["severity"], error))
    found: Curves = {}
    for (observer, kind, channel), line in points.items():
        found.setdefault(observer, {}).setdefault(kind, {})[channel] = Curve(*np.array(line).T)
    return found


def shown_observers(names: Sequence[str], deployed: str | None) -> list[str]:
    """Return the few observers of a figure: the deployed one first, of one kind of model, without those that nobody would tune so."""
    model = split_observer(deployed or (names[0] if names else ""))[0]
    kept = [n for n in names if n == deployed or (split_observer(n)[0] in (model, "") and split_observer(n)[1] not in _LEFT_OUT)]
    return sorted(kept, key=lambda n: n != deployed)


def look(name: str) -> Look:
    """Return how an observer's curve looks: here all are of one kind of model, and hue tells the method."""
    return _LOOKS.get(split_observer(name)[1], Look(Tone.GREY.light, ":"))


def severity_text(kind: Kind, severity: float, smallest: float) -> str:
    """Return a severity for people, in the unit of its axis; "<" the smallest one that was tried, a dash where there is none."""
    text = number(max(severity, smallest) * AXES[kind].factor, 2)
    return f"< {text}" if severity < smallest else text
