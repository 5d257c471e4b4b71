r"""Units scored by the innovation of the deployed observer: what `kros check` can say where only measured channels and inputs were recorded.

With :math:`\rho` the RMS of the innovation over a unit's episodes, the score is its level against the study's other units in the same condition,

.. math:: s = \max_c 20 \log_{10} \rho_c - \overline{20 \log_{10} \rho_c},

the largest of all measured channels. Levels are taken as normally distributed over units, so a further unit is beyond

.. math:: t_{n-1}(1 - \alpha / q) \, s_\rho \sqrt{1 + 1/n}

with probability :math:`\alpha` at most. A reference whose motion is another has another level: the score is for motion like the study's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from ...core.artifacts import load_artifact
from ...data.population import OUTLIERS
from ...data.survey import RecordingFacts
from ...observer.sensor import Sensors
from ...uncertainty import Status
from ..config import StudyConfig
from ..engine.store import Store
from .field import FieldEpisodes, FieldRecordings, count_status

Array = npt.NDArray[np.float64]
_FEWEST = 3


def score_innovations(config: StudyConfig, store: Store, recordings: FieldRecordings, missing: list[str]) -> list[dict[str, Any]]:
    """Return a row for every unit and condition, as `kros check` does, with the scores that need hidden channels left unknown.

    ``innovation_db`` and ``innovation_threshold_db`` are None where the run has not evaluated its observer in the condition, on at least three units.
    """
    population, observer = recordings.population, recordings.observer
    names = [observer.lifting.states[i] for i in observer.measured]
    known, rate = levels(store, observer.name, observer.sensor), config.uncertainty.false_alarm_rate / len(names)
    rows = []
    for unit, condition, keys in population.groups():
        rms: list[Array] = []
        counts: dict[str, dict[str, int]] = {}
        samples = 0
        for found in recordings.episodes(keys):
            rms.append(innovation_rms(found, list(observer.measured)))
            samples += int(found.batch.lengths.sum())
            count_status(found, counts)
        own = np.concatenate(rms).mean(axis=0)
        pairs = [against(float(level), known.get((condition, name), {}), unit, rate) for level, name in zip(own, names, strict=True)]
        score, threshold = max((p for p in pairs if p is not None), key=lambda p: p[0] - p[1], default=(None, None))
        outlier = score is not None and threshold is not None and score > threshold
        seconds = samples * population.sample_period_s
        row: dict[str, Any] = {"unit": unit, "condition": condition, "score": None, "threshold": None, "outlier": outlier}
        row |= {
            "status": Status.OUTLIER if outlier else Status.CANNOT_TELL,
            "detectable": None,
            "episodes": len(keys),
            "recorded_s": seconds,
        }
        row |= {"missing": missing, "innovation_db": score, "innovation_threshold_db": threshold}
        row |= {"innovation_rms": dict(zip(names, own.tolist(), strict=True)), "samples": counts.get(unit, {})}
        rows.append(
            row | {"parameters": recordings.sources.get(unit), "left_out": [unit] if any(unit in units for units in known.values()) else []}
        )
    return rows


def innovation_rms(found: FieldEpisodes, measured: list[int]) -> Array:
    """Return the RMS innovation of every episode, shape (batch, q), without its first quarter: recordings in the field may start in motion."""
    at, lengths = np.arange(len(found.y))[:, None, None], found.batch.lengths[:, None]
    counts = np.isfinite(found.y) & (at >= lengths // 4) & (at < lengths)
    total = np.sum((found.y - found.estimates[..., measured]) ** 2, axis=0, where=counts)
    number = counts.sum(axis=0)
    return np.asarray(np.sqrt(np.divide(total, number, out=np.zeros_like(total), where=number > 0)))


def levels(store: Store, observer: str, sensor: Sensors) -> dict[tuple[str, str], dict[str, float]]:
    """Return the RMS innovation on held-out episodes by unit, for every condition and measured channel, as the study evaluated its observer.

    Nothing where it was not evaluated, or under a sensor that was declared to be worse than the recordings'.
    """
    if not store.holds("evaluation", "evaluation.json") or any(s.noise or s.bias or s.jitter_samples or s.dropout for s in sensor.values()):
        return {}
    groups = RecordingFacts.load(store.path("population")).groups
    found: dict[tuple[str, str], dict[str, float]] = {}
    for row in load_artifact(store.path("evaluation"), "evaluation")[0]["rows"]:
        if row["observer"] == observer and groups.get(row["unit"]) != OUTLIERS and row["rms"] > 0:
            found.setdefault((row["condition"], row["channel"]), {})[row["unit"]] = row["rms"]
    return found


def against(rms: float, known: dict[str, float], unit: str, rate: float) -> tuple[float, float] | None:
    """Return a level over the mean of the other units', and its threshold, dB; None where there are too few."""
    others = 20 * np.log10([value for name, value in known.items() if name != unit])
    if len(others) < _FEWEST or not rms > 0:
        return None
    spread = float(np.std(others, ddof=1)) * np.sqrt(1 + 1 / len(others))
    return 20 * np.log10(rms) - float(others.mean()), float(student.ppf(1 - rate, len(others) - 1)) * spread


def innovation_line(row: dict[str, Any]) -> str:
    """Return a row of `score_innovations` for people at a terminal."""
    hidden = f"without {', '.join(row['missing'])} there is no score of its model"
    line = f"{row['unit']}  {row['condition']}  {row['status'].upper() if row['outlier'] else row['status']}: {hidden}"
    if row["innovation_db"] is None:
        line += "; the run has too few units that its observer was evaluated on in this condition to compare the innovation with"
    else:
        line += f"; innovation {row['innovation_db']:+.2f} dB over the study's units (threshold {row['innovation_threshold_db']:.2f} dB)"
    line += "".join(f"; {count} samples {bit}" for bit, count in row["samples"].items())
    return line + (f"; parameters {row['parameters']}" if row["parameters"] else "")
