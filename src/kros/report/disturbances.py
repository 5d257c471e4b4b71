"""Errors against the severity of disturbed measurements: curves from the metrics, and where an error doubles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..evaluate.disturb import Kind, severity_of_growth
from .facts import Facts
from .names import number

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """Axis of the severities of one kind: title, factor from the metrics' unit, whether it is logarithmic."""

    title: str
    factor: float = 1.0
    logarithmic: bool = True


AXES = {
    Kind.NOISE: Axis("noise (% of the largest value)", 100.0),
    Kind.QUANTISATION: Axis("resolution (% of the largest value)", 100.0),
    Kind.BIAS: Axis("bias (% of the largest value)", 100.0),
    Kind.PHASE: Axis("phase error (rad)", logarithmic=False),
    Kind.DELAY: Axis("undeclared delay (samples)"),
    Kind.DROPPED: Axis("lost samples (%)", 100.0, logarithmic=False),
    Kind.GAP: Axis("length of gaps (samples)"),
}


class Curve(NamedTuple):
    """Error of an observer in a channel, percent of the largest value, against a disturbance's severity."""

    severities: Array
    errors: Array


Curves = dict[str, dict[Kind, dict[str, Curve]]]


def curves(rows: Sequence[Mapping[str, Any]], condition: str) -> Curves:
    """Return curves of mean errors by observer, kind and channel from ``robustness`` of the metrics."""
    plain: dict[tuple[str, str], float] = {}
    points: dict[tuple[str, Kind, str], list[tuple[float, float]]] = {}
    for row in (r for r in rows if r["condition"] == condition):
        value, observer, channel = row["error_percent"]["mean"], row["observer"], row["channel"]
        error = np.inf if value is None else float(value)
        if row["disturbance"] == "none":
            plain[observer, channel] = error
        else:
            start = [(0.0, plain[observer, channel])]
            points.setdefault((observer, Kind(row["disturbance"]), channel), start).append((row["severity"], error))
    lines: Curves = {}
    for (observer, kind, channel), line in points.items():
        lines.setdefault(observer, {}).setdefault(kind, {})[channel] = Curve(*np.array(line).T)
    return lines


def _doubling(kind: Kind, by_channel: Mapping[str, Curve], measured: Sequence[str]) -> str:
    """Return the severity at which the error of hidden states doubles, as text."""
    hidden = [curve for c, curve in by_channel.items() if c not in measured] or list(by_channel.values())
    with np.errstate(divide="ignore"):
        errors = np.exp(np.mean([np.log(curve.errors) for curve in hidden], axis=0))
    tried = AXES[kind].factor * hidden[0].severities
    severity = AXES[kind].factor * severity_of_growth(hidden[0].severities, errors)
    if not np.isfinite(severity):
        return f"> {number(tried[-1], 2)}"
    return f"{'< ' if severity < tried[1] else ''}{number(max(severity, tried[1]), 2)}"


def doublings(facts: Facts) -> dict[str, dict[Kind, str]]:
    """Return by observer and kind the severity at which its error doubles in the condition of the models."""
    tried, measured = curves(facts.get("robustness", []), facts.study["identify_on"]), facts.measured
    pairs = {name: [(kind, lines[kind]) for kind in AXES if kind in lines] for name, lines in tried.items()}
    return {name: {kind: _doubling(kind, of, measured) for kind, of in lines} for name, lines in pairs.items()}
