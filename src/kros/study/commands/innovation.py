"""The monitor of the deployed observer on recordings, for `kros check` where hidden channels were not recorded."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...evaluate.arriving import Arriving
from ...observer import Observer
from ...observer.monitor import Monitor
from ...observer.simulate import run_innovations
from ...uncertainty.outliers.score import FEWEST_UNITS, Status
from .field import FieldRecordings

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


def monitored(recordings: FieldRecordings) -> list[dict[str, Any]]:
    """Return a row for every unit and condition, as `kros check` does, with what needs hidden channels left unknown."""
    population, observer = recordings.population, recordings.observer
    monitor, rows = observer.monitor, []
    for unit, condition, keys in population.groups():
        innovations: list[tuple[Array, Flags]] = []
        counts: dict[str, dict[str, int]] = {}
        samples = 0
        for found in recordings.batches(keys):
            samples += int(found.batch.lengths.sum())
            recordings.count_status(found, counts)
            if monitor is not None:
                innovations += judged_innovations(recordings, monitor, found)
        highest, bands = highest_levels(monitor, innovations, condition)
        outlier = monitor is not None and monitor.units >= FEWEST_UNITS and highest is not None and highest > 0
        row: dict[str, Any] = {"unit": unit, "condition": condition, "outlier": outlier}
        row |= {
            "score": None,
            "threshold": None,
            "status": Status.OUTLIER if outlier else Status.CANNOT_TELL,
            "detectable": None,
            "episodes": len(keys),
        }
        row |= {"recorded_s": samples * population.sample_period_s, "left_out": []}
        row |= {"missing": [name for name in observer.recorded if name not in population.states], "level_db": highest}
        rate, units = (None, None) if monitor is None else (monitor.false_alarm_rate, monitor.units)
        row |= {"level_rate": rate, "level_units": units, "samples": counts.get(unit, {})}
        row |= {"bands_db": by_band(observer, monitor, bands) if monitor is not None and bands is not None else None}
        rows.append(row | {"parameters": recordings.sources.get(unit)})
    return rows


def by_band(observer: Observer, monitor: Monitor, levels: Array) -> dict[str, dict[str, float]]:
    """Return levels, shape (q, bands), by the name of the measured channel and the centre frequency in Hz."""
    names = [observer.lifting.states[i] for i in observer.measured]
    centres = [f"{hz:.3g}" for hz in monitor.centres_hz(observer.sample_period_s)]
    return {name: dict(zip(centres, row.tolist(), strict=True)) for name, row in zip(names, levels, strict=True)}


def judged_innovations(recordings: FieldRecordings, monitor: Monitor, found: Arriving) -> list[tuple[Array, Flags]]:
    """Return the innovations of every episode, shape (n_samples, q), and which samples are judged."""
    observer, every = recordings.observer, list(range(len(found.batch.keys)))
    nu, judged = run_innovations(observer, found.y, found.u, found.parameters(observer, every), monitor.settle)
    return [(nu[:length, i], judged[:length, i]) for i, length in enumerate(found.batch.lengths)]


def highest_levels(
    monitor: Monitor | None, innovations: list[tuple[Array, Flags]], condition: str
) -> tuple[float | None, Array | None]:
    """Return the highest level over the bound, dB, and that of every band; None where nothing is judged."""
    if monitor is None or not any(judged.any() for _, judged in innovations):
        return None, None
    squares = np.concatenate(monitor.in_turn(innovations))
    known = condition if condition in monitor.bounds else None
    return float(monitor.level(squares, known).max()), monitor.band_levels(squares.max(axis=0))


def level_text(row: dict[str, Any]) -> str:
    """Return where the level of the innovation is."""
    return f"{abs(row['level_db']):.2f} dB {'over' if row['level_db'] > 0 else 'below'} the monitor's bound"
