"""Errors against severity: curves from the rows of the metrics, titles of their axes, which observers are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..evaluate import Kind
from ..evaluate.robustness import severity_of_growth
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
    Kind.GAP: Axis("gap length (samples)"),
    Kind.BIAS: Axis("bias (% of the largest value)", 100.0),
    Kind.QUANTISATION: Axis("resolution (% of the largest value)", 100.0),
    Kind.NOISE: Axis("noise (% of the largest value)", 100.0),
    Kind.PHASE: Axis("phase error (rad)", logarithmic=False),
    Kind.DELAY: Axis("delay (samples)"),
}
_LOOKS = {
    "worst_case_h2": Look(Tone.BLUE.light),
    "residual_h2": Look(Tone.INK.light),
    "memory": Look(Tone.SKY.light),
    "mixed": Look(Tone.ORANGE.light),
    "open_loop": Look(Tone.GREY.light),
    "kalman_tuned": Look(Tone.PURPLE.light, "--"),
    "ekf": Look(Tone.PURPLE.light),
    "filtered_difference": Look(Tone.GOLD.light),
    "learned": Look(Tone.GREEN.light),
    "mean_profile": Look(Tone.GREEN.light, ":"),
}


class Curve(NamedTuple):
    """Error of an observer in a channel, percent of the largest value, against a disturbance's severity."""

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
    """Return the few observers of a figure: the deployed one first, of one kind of model."""
    model = split_observer(deployed or (names[0] if names else ""))[0]
    kept = [n for n in names if n == deployed or split_observer(n)[0] in (model, "")]
    return sorted(kept, key=lambda n: n != deployed)


def look(name: str) -> Look:
    """Return how an observer's curve looks: here all are of one kind of model, and hue tells the method."""
    return _LOOKS.get(split_observer(name)[1], Look(Tone.GREY.light, ":"))


def doubling(kind: Kind, by_channel: Mapping[str, Curve], measured: Sequence[str]) -> tuple[float, float] | None:
    """Return the severity at which the error of unmeasured states doubles, and the smallest one tried."""
    hidden = [curve for c, curve in by_channel.items() if c not in measured] or list(by_channel.values())
    if not hidden:
        return None
    with np.errstate(divide="ignore"):
        errors = np.exp(np.mean([np.log(curve.errors) for curve in hidden], axis=0))
    return severity_of_growth(hidden[0].severities, errors), float(hidden[0].severities[1])


def needed(
    own: Mapping[Kind, Mapping[str, Curve]], measured: Sequence[str], kinds: Sequence[Kind], words: Mapping[Kind, str]
) -> list[str]:
    """Return in words, with a place for the severity, where an observer's error doubles; kinds that do not double it are left out."""
    texts = []
    for kind in kinds:
        found = doubling(kind, own.get(kind, {}), measured)
        if found is not None and np.isfinite(found[0]):
            at = max(found)
            value = f"{at:.2g}" if kind is Kind.DELAY else number(at * AXES[kind].factor, 2)
            texts.append(words[kind].format(f"less than {value}" if found[0] < found[1] else value))
    return texts


def needed_sensor(metrics: Mapping[str, Any], measured: Sequence[str]) -> list[str]:
    """Return the sentence that says what sensor and timing the deployed observer needs; none where the study did not try."""
    study = metrics["study"]
    own = curves(metrics.get("robustness", []), study["identify_on"]).get(study.get("deployed"), {})
    if not own:
        return []
    parts = needed(own, measured, tuple(_NEEDS), _NEEDS)
    sensor = "sensor that is declared" if study.get("sensor") else "recordings' own sensor"
    if not parts:
        return [
            f"No noise, resolution, bias, delay or loss of samples that was tried beyond the {sensor} doubles its error."
        ]
    listed = f"{', '.join(parts[:-1])} or {parts[-1]}" if parts[1:] else parts[0]
    return [f"Beyond the {sensor}, its error doubles with {listed}: this is the sensor and timing it needs."]


_NEEDS = {
    Kind.NOISE: "noise of {} % of the largest value",
    Kind.QUANTISATION: "a resolution of {} %",
    Kind.BIAS: "a bias of {} %",
    Kind.DELAY: "a delay of {} sample(s) that it is not told of",
    Kind.DROPPED: "{} % of the samples lost",
}
