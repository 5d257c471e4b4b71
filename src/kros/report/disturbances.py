"""Errors against severity as the report tells them: curves from the rows of the metrics, how severities are called, which observers are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..evaluate import Kind
from .names import Look, number, split_observer
from .theme import Tone

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """How severities of one kind are told: title of the axis, factor from the metrics' unit, whether the axis is logarithmic."""

    title: str
    factor: float = 1.0
    logarithmic: bool = True


AXES = {
    Kind.DROPPED: Axis("samples lost (%)", 100.0, logarithmic=False),
    Kind.GAP: Axis("gaps of (ms)", 1e3),
    Kind.BIAS: Axis("bias (% of the largest value)", 100.0),
    Kind.QUANTISATION: Axis("resolution (% of the largest value)", 100.0),
    Kind.NOISE: Axis("noise (% of the largest value)", 100.0),
    Kind.PHASE: Axis("wrong phase (rad)", logarithmic=False),
    Kind.DELAY: Axis("late by (samples)"),
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


@dataclass(frozen=True, eq=False)
class Curve:
    """Mean error of one observer in one channel against the severity of one disturbance; the first severity is zero.

    Parameters
    ----------
    severities : ndarray, shape (k,)
    errors : ndarray, shape (k,), percent of the largest value
        Infinite where an estimate diverged.
    """

    severities: Array
    errors: Array


Curves = dict[str, dict[Kind, dict[str, Curve]]]


def curves(rows: Sequence[Mapping[str, Any]], condition: str, what: str = "mean") -> Curves:
    """Return curves by observer, kind and channel.

    Parameters
    ----------
    rows : sequence of mapping
        ``robustness`` of the metrics.
    condition : str
    what : {"mean", "worst"}
        Of the units.
    """
    plain: dict[tuple[str, str], float] = {}
    found: dict[str, dict[Kind, dict[str, list[tuple[float, float]]]]] = {}
    for row in rows:
        if row["condition"] != condition:
            continue
        value = row["error_percent"][what]
        error = np.inf if value is None else float(value)
        place = (row["observer"], row["channel"])
        if row["disturbance"] == "none":
            plain[place] = error
        else:
            kind = Kind(row["disturbance"])
            found.setdefault(place[0], {}).setdefault(kind, {}).setdefault(place[1], [(0.0, plain[place])]).append((row["severity"], error))
    return {
        o: {kind: {c: Curve(*np.array(points).T) for c, points in by_channel.items()} for kind, by_channel in by_kind.items()}
        for o, by_kind in found.items()
    }


def shown_observers(names: Sequence[str], deployed: str | None) -> list[str]:
    """Return the few observers of a figure: the one that is handed over first, of one kind of model, without those that nobody would tune so."""
    model = split_observer(deployed or (names[0] if names else ""))[0]
    kept = [n for n in names if n == deployed or (split_observer(n)[0] in (model, "") and split_observer(n)[1] not in _LEFT_OUT)]
    return sorted(kept, key=lambda n: n != deployed)


def look(name: str) -> Look:
    """Return how an observer's curve looks: here all are of one kind of model, and hue tells the method."""
    return _LOOKS.get(split_observer(name)[1], Look(Tone.GREY.light, ":"))


def severity_text(kind: Kind, severity: float, smallest: float) -> str:
    """Return a severity for people, in the unit of its axis; no more than "less" than the smallest one that was tried, and a dash where there is none."""
    text = number(max(severity, smallest) * AXES[kind].factor, 2)
    return f"< {text}" if severity < smallest else text
