"""Every unit: its errors, score, residual and phase in a table, and all that is known of it behind its name."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...core.artifacts import load_artifact
from ...core.errors import KrosError
from ...data import EpisodeBatch
from ...data.population import EpisodeKey
from ...evaluate.sensor import as_shown
from ...observer import run_observer
from ..content import Cell, Cells, Panel, Section, Table
from ..figures.recordings.phase import GOOD
from ..names import axis_label, channel_units, condition_label, in_condition, minus, number, observer_label, readable_unit
from ..run_folder import Array, NotShownError, RunFolder
from ..sparks import spark
from ..theme import Tone
from .outliers import score_card, score_names, some_of, undecided_text

log = logging.getLogger(__name__)
Row = Mapping[str, Any]
_MOST, _ROWS = 100, 400  # units that get a panel with pictures, and units that all get a row; more would make the page too large
_FAR = 20  # largest of every column that get a row where not all do
_SHARES = {"5 %": 0.05, "median": 0.5, "95 %": 0.95}


@dataclass
class _Known:
    """What the metrics and the run know of one unit, part by part."""

    own: Row = field(default_factory=dict)
    errors: list[Row] = field(default_factory=list)
    scores: list[Row] = field(default_factory=list)
    bound: Row = field(default_factory=dict)


def section(run: RunFolder, metrics: Row) -> Section | None:
    """Return the table of units and a panel for each; None where no unit is known."""
    if not metrics.get("units"):
        return None
    found, name = _known(run, metrics), metrics["study"].get("deployed")
    hidden = [c for c in dict.fromkeys(r["channel"] for known in found.values() for r in known.errors) if c not in run.measured_states]
    flagged = [unit for unit, known in found.items() if any(r["outlier"] for r in known.scores)]
    named = some_of(flagged)
    text = f"A name leads to all that is known of the unit{f', with “{observer_label(name)}”' if name else ''}. "
    text += f"Flagged as not belonging to the batch: {named}." if flagged else "No unit is flagged."
    shown, tables = found, list[Table]()
    if len(found) > _ROWS:
        columns = _columns(metrics, found, hidden)
        shown, tables = _extremes(found, columns), [_quantiles(columns, len(found))]
    panels = _panels(run, metrics, dict(list(shown.items())[:_MOST]))
    cut = (
        "Every unit"
        if shown is found
        else f"{len(shown)} of {len(found)} units, those flagged and the {_FAR} largest of every column; metrics.json has all"
    )
    tables.append(_table(run, metrics, shown, hidden, {p.key for p in panels}, cut))
    return Section("units", "Units", [text, *undecided_text(metrics.get("outliers", []))], tables, panels=panels)


def _columns(metrics: Row, found: Mapping[str, _Known], hidden: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return numbers of units by what they are and unit, where they are known."""
    home = metrics["study"]["identify_on"]
    columns: dict[str, dict[str, float]] = {f"error of {c.replace('_', ' ')} (%)": {} for c in hidden}
    for unit, known in found.items():
        for row in known.errors:
            if row["channel"] in hidden and row["condition"] == home:
                columns[f"error of {row['channel'].replace('_', ' ')} (%)"][unit] = (
                    math.inf if row["error_percent"] is None else row["error_percent"]
                )
        for row in known.scores:
            if row["score"] is not None:
                columns.setdefault(f"outlier score, {condition_label(row['condition'])} (dB)", {})[unit] = row["score"]
        if known.bound.get("residual") is not None:
            columns.setdefault("residual", {})[unit] = known.bound["residual"]
    return {title: values for title, values in columns.items() if values}


def _extremes(found: Mapping[str, _Known], columns: Mapping[str, Mapping[str, float]]) -> dict[str, _Known]:
    """Return the units that are flagged, and those that are the largest in some column."""
    flagged = [unit for unit, known in found.items() if any(r["outlier"] for r in known.scores)]
    largest = [unit for values in columns.values() for unit in sorted(values, key=lambda u: -values[u])[:_FAR]]
    return {unit: found[unit] for unit in list(dict.fromkeys(flagged + largest))[:_ROWS]}


def _quantiles(columns: Mapping[str, Mapping[str, float]], units: int) -> Table:
    """Return how numbers of units are spread, with the unit that is at the upper end."""
    rows: list[Cells] = []
    for title, values in columns.items():
        numbers, last = np.array(list(values.values())), max(values, key=lambda u: values[u])
        inner = [number(float(np.quantile(numbers, share, method="nearest"))) for share in _SHARES.values()]
        rows.append([title, str(len(numbers)), number(float(numbers.min())), *inner, number(float(numbers.max())), last])
    return Table(["", "units", "smallest", *_SHARES, "largest", "which is"], rows, f"How {units} units are spread")


def _known(run: RunFolder, metrics: Row) -> dict[str, _Known]:
    """Collect what is known of every unit, those that are flagged first, then by name."""
    name = metrics["study"].get("deployed")
    found = {row["unit"]: _Known(row) for row in metrics["units"]}
    for row in metrics.get("evaluation", []):
        if row["observer"] == name and row["unit"] in found:
            found[row["unit"]].errors.append(row)
    for row in metrics.get("outliers", []):
        if row["unit"] in found:
            found[row["unit"]].scores.append(row)
    if run.has("observers/relift.json"):
        for row in load_artifact(run.folder / "observers", "relift")[0]["rows"].get(name, []):
            if row["unit"] in found:
                found[row["unit"]].bound = row
    return dict(sorted(found.items(), key=lambda item: (not any(r["outlier"] for r in item[1].scores), item[0])))


def _table(run: RunFolder, metrics: Row, found: Mapping[str, _Known], hidden: Sequence[str], panels: set[str], cut: str) -> Table:
    home, units = metrics["study"]["identify_on"], channel_units(metrics)
    conditions = list(dict.fromkeys(r["condition"] for r in metrics.get("outliers", [])))
    rows: list[Cells] = []
    for unit, known in found.items():
        status = "flagged" if any(r["outlier"] for r in known.scores) else known.own.get("status", "ok")
        row: list[Cell | str] = [Cell(unit, href=_key(unit) if _key(unit) in panels else ""), Cell(status, strong=status != "ok")]
        errors = {r["channel"]: r for r in known.errors if r["condition"] == home}
        for channel in hidden:
            own = errors.get(channel, {})
            row += [_cell(own.get("rms")), _cell(own.get("error_percent"))]
        scores = {r["condition"]: r for r in known.scores}
        row += [_cell(scores.get(c, {}).get("score"), strong=bool(scores.get(c, {}).get("outlier"))) for c in conditions]
        row += [_cell(known.bound.get("residual"))] if any(k.bound for k in found.values()) else []
        row += [_cell(_degrees(known.own.get("phase_rad")))] if run.calibrated else []
        rows.append(row)
    head = ["unit", "status", *(t for c in hidden for t in (axis_label("RMS", units.get(c, "")), "%"))]
    head += [f"{condition_label(c)} (dB)" for c in conditions]
    groups = [
        ("", 2),
        *((f"error of {c.replace('_', ' ')}", 2) for c in hidden),
        *([("outlier score", len(conditions))] if conditions else []),
    ]
    last = [*(["residual"] if any(k.bound for k in found.values()) else []), *(["phase (°)"] if run.calibrated else [])]
    caption = f"{cut}{in_condition(home)}; % of the largest value, the residual relative to the population's"
    return Table([*head, *last], rows, caption, [*groups, *([("", len(last))] if last else [])], sortable=True)


def _cell(value: float | None, strong: bool = False) -> Cell:
    return Cell(number(value), strong=strong, value=value)


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def _key(unit: str) -> str:
    return "unit-" + "".join(c if c.isalnum() else f"-{ord(c):x}-" for c in unit)


def _panels(run: RunFolder, metrics: Row, found: Mapping[str, _Known]) -> list[Panel]:
    pictures = _signals(run, found)
    residuals = _residuals(run, metrics)
    names = {r["condition"]: score_names(run, r["condition"]) for r in metrics.get("outliers", [])}
    panels = []
    for unit, known in found.items():
        scores = [score_card(r, names[r["condition"]]).removeprefix(f"Unit {unit} ") for r in known.scores]
        card = [("Phase", _phase(run, unit)), ("Scores", scores), ("Bound as it runs", _bound(known.bound))]
        table = [_errors(known.errors, channel_units(metrics))] if known.errors else []
        group, status = known.own.get("group") or "population", known.own.get("status", "ok")
        recorded = ", ".join(condition_label(c) for c in known.own.get("conditions", []))
        title = f"Unit {unit}: {group}, {status}" + (f"; recorded {recorded}" if recorded else "")
        panels.append(
            Panel(_key(unit), title, [(t, told) for t, told in card if told], table, [*pictures.get(unit, []), *residuals.get(unit, [])])
        )
    return panels


def _phase(run: RunFolder, unit: str) -> list[str]:
    own = run.calibration.units.get(unit) if run.calibrated else None
    if own is None:
        return []
    weak = "; low, so the phase is uncertain" if own.concentration < GOOD else ""
    phase, lag = (minus(f"{math.degrees(value):.1f}") for value in (own.phase_rad, own.lag_rad))
    return [
        f"{phase}° with a lag of {lag}°, from {own.n_segments} segments at constant speed, concentration {number(own.concentration, 4)}{weak}."
    ]


def _bound(row: Row) -> list[str]:
    if not row:
        return []
    told = {key: number(100 * row[key]) for key in ("error", "bound", "gain_bound")}
    return [
        f"Error {told['error']} %, bound {told['bound']} % (by the gain alone {told['gain_bound']} %), all states together; residual {number(row['residual'])} "
        "times the population's."
    ]


def _errors(rows: Sequence[Row], units: Mapping[str, str]) -> Table:
    cells: list[Cells] = [
        [
            r["channel"].replace("_", " "),
            condition_label(r["condition"]),
            f"{number(r['rms'])} {readable_unit(units.get(r['channel'], ''))}".strip(),
            "diverged" if r["error_percent"] is None else number(r["error_percent"]),
        ]
        for r in rows
    ]
    return Table(["error of", "condition", "RMS", "% of the largest value"], cells)


def _signals(run: RunFolder, found: Mapping[str, _Known]) -> dict[str, list[str]]:
    """Draw recorded and estimated hidden states, and the error below, of the first held-out episode of every unit; nothing where recordings are gone."""
    try:
        home, calibrated = run.identify_on, run.calibration.units if run.calibrated else {}
        keys = {key.unit: key for key in (EpisodeKey(*row) for row in reversed(run.facts["test"])) if key.condition == home}
        keys = {unit: key for unit, key in keys.items() if unit in found and (not run.calibrated or unit in calibrated)}
        observer, population = run.observer, run.population
        parameters = {u: {run.calibration.spec.parameter: calibrated[u].phase_rad} for u in keys} if run.calibrated else None
        batch = EpisodeBatch.read(population, list(keys.values()), parameters=parameters)
        shown = as_shown(batch, observer.sensor, population.states)
        own = observer.own(batch.parameters)
        estimate = run_observer(observer, shown.measurements(observer.measured), batch.inputs, own)
    except (NotShownError, KrosError, OSError) as reason:
        log.info("signals of units are left out: %s", reason)
        return {}
    hidden = [(i, c) for i, c in enumerate(run.states) if not c.measured][:2]
    pictures = {}
    for k, unit in enumerate(keys):
        length = int(batch.lengths[k])
        time_s = np.arange(length) * batch.sample_period_s
        pictures[unit] = [
            picture
            for i, channel in hidden
            for picture in _pair(axis_label(channel.name, channel.unit), time_s, batch.states[:length, k, i], estimate[:length, k, i])
        ]
    return pictures


def _pair(label: str, time_s: Array, recorded: Array, estimate: Array) -> list[str]:
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.where(np.abs(estimate) < 1e6, recorded - estimate, np.nan)
    if not np.isfinite(error).any():
        return [(spark(f"{label}, recorded; the estimate diverges", time_s, [(recorded, Tone.INK, 1.0)], "s"))]
    return [
        (spark(f"{label}, recorded", time_s, [(recorded, Tone.INK, 1.0)], "s")),
        (spark(f"{label}, recorded minus estimated", time_s, [(error, Tone.BLUE, 0.8)], "s")),
    ]


def _residuals(run: RunFolder, metrics: Row) -> dict[str, list[str]]:
    """Draw every unit's residual over the weights, with the largest of all units, of the models behind the deployed observer."""
    model = (metrics["study"].get("deployed") or "").rpartition("/")[0]
    try:
        found = run.unit_residuals
    except NotShownError:
        return {}
    residuals = found.get(model) or next(iter(found.values()))
    levels = 20 * np.log10(np.maximum(residuals.ratio, 1e-3))
    kept = residuals.freqs_hz > 0
    freqs, most = residuals.freqs_hz[kept], levels.max(axis=0)[kept]
    lines = {
        u: [(most, Tone.GREY, 1.0), (levels[k][kept], Tone.BLUE, 1.2)]
        for k, u in enumerate(residuals.unit_ids)
        if u != residuals.nominal_id
    }
    return {
        u: [(spark("Residual over the weights (dB); grey: the largest of all units", freqs, own, "Hz", logarithmic=True))]
        for u, own in lines.items()
    }
