"""Where the numbers come from: recordings, models, spread of the units, weights, the run."""

from __future__ import annotations

import math
import platform
from importlib import import_module

from ...core.linalg import radius_text
from ...data import some
from ..content import Column, Section, build
from ..facts import Facts
from ..names import in_condition, minus, model_label, number, words

_PACKAGES = ("kros", "numpy", "scipy", "matplotlib")


def recordings(facts: Facts) -> Section:
    """Return units, conditions, episodes and channels."""
    study = facts.study
    counts = [
        f"{n['train']} for training and {n['held_out']} held out{in_condition(c)}"
        for c, n in study.get("episodes", {}).items()
    ]
    text = f"{study['units']} units, sampled every {study['sample_period_s']:g} s."
    text += f" Episodes: {'; '.join(counts)}." if counts else ""
    aside = [row["unit"] for row in facts.get("units", []) if row.get("group") == "outliers"]
    text += f" Set aside as outliers: {some(aside)}." if aside else ""
    text += f" Dropped for bad samples: {some(study['dropped'])}." if study.get("dropped") else ""
    channels, sensor = study.get("channels", {}), study.get("sensor", {})
    roles = dict.fromkeys(study.get("inputs", ()), "input") | dict.fromkeys(facts.measured, "measured")
    declared = [", ".join(f"{words(k)} {v:g}" for k, v in sensor.get(c, {}).items() if v) for c in channels]
    columns = [
        Column("channel", [words(c) for c in channels]),
        Column("unit", [u or "–" for u in channels.values()]),
        Column("role", [roles.get(c, "estimated") for c in channels]),
        Column("resolution", [study.get("resolution", {}).get(c) for c in channels]),
        Column("declared sensor", declared),
    ]
    return Section("recordings", "Recordings", [text], tables=[build("Channels", columns)], figure="signals")


def calibration(facts: Facts) -> Section | None:
    """Return the phase calibration; None for a study without one."""
    entry = facts.get("calibration")
    if not entry:
        return None
    text = (
        f"The gearbox disturbance is modelled as sin({entry['ratio']:g} · {entry['angle']} + {entry['parameter']}); "
        "the phase differs from unit to unit. It is estimated from segments of constant speed, forward and reverse "
        f"apart. Mean lag of the loop: {minus(format(math.degrees(entry['lag_rad']), '.1f'))}°."
    )
    missing = [row["unit"] for row in facts.get("units", []) if row["status"] == "not calibrated"]
    more = [f"Not calibrated, and without models: {some(missing)}."] if missing else []
    return Section("calibration", "Phase calibration", [text, *more], figure="phase")


def models(facts: Facts) -> Section | None:
    """Return the models and their simulation errors."""
    entries = facts.get("models")
    if not entries:
        return None
    functions: list[str] = next((entry["functions"] for entry in entries.values() if entry.get("functions")), [])
    text = "Every unit has a model of each kind. Linear models have the recorded states."
    text += f" Koopman models have lifted functions as well: {', '.join(functions)}." if functions else ""
    if any(not name.endswith("_edmd") for name in entries):
        text += " Refined models minimise the simulation error, regularised towards the population mean; the strength "
        text += "is chosen on the last training episode of every unit."
    errors = {name: entry.get("freerun_error_percent", {}) for name, entry in entries.items()}
    columns = [
        Column("model", [model_label(name) for name in entries]),
        Column("states", [entry["order"] for entry in entries.values()]),
        Column("largest pole", [minus(radius_text(entry["spectral_radius_max"])) for entry in entries.values()]),
    ]
    for channel in dict.fromkeys(c for entry in errors.values() for c in entry):
        for what in ("median", "worst"):
            values = [entry.get(channel, {}).get(what) for entry in errors.values()]
            columns.append(Column(f"{what} (%)", values, words(channel), best=True))
    caption = "Simulation of held-out episodes from their first state, error in percent of the largest value"
    return Section("models", "Models", [text], tables=[build(caption, columns)], figure="free_run")


def spread(facts: Facts) -> Section | None:
    """Return how the units differ from the nominal one."""
    entries = facts.get("uncertainty")
    if not entries:
        return None
    first = next(iter(entries.values()))
    text = (
        f"Nominal unit: {first['nominal']}. The residual of a unit is its difference from the nominal unit in one of "
        f"six forms; its peak is the largest singular value over units and frequencies. The design uses the form "
        f"“{words(first['form'])}”. Below 0 dB a unit differs by less than the whole signal."
    )
    forms = list(dict.fromkeys(f for entry in entries.values() for f in entry["peak_db"]))
    used = ["used" if form == first["form"] else "" for form in forms]
    columns = [Column("form", [words(form) for form in forms], notes=used)]
    columns += [Column(f"{model_label(n)} (dB)", [e["peak_db"].get(f) for f in forms]) for n, e in entries.items()]
    table = build("Peak residual, with the nominal unit that suits each form best", columns, words(first["form"]))
    return Section("spread", "Spread of the units", [text], tables=[table], figure="models")


def uncertainty(facts: Facts) -> Section | None:
    """Return the weights that bound the residuals of all units."""
    entries = facts.get("uncertainty")
    if not entries:
        return None
    text = (
        "Each residual is W_left · Δ · W_right with ‖Δ‖ ≤ 1. The weights bound every unit where no normalised residual "
        "exceeds one. The approximation error is what the form cannot represent; it is covered by an additive term."
    )
    weights = [entry["weight"] for entry in entries.values()]
    noise = [entry.get("noise_share") for entry in entries.values()]
    orders = [" and ".join(", ".join(map(str, side)) for side in entry["orders"]) for entry in weights]
    columns = [
        Column("model", [model_label(name) for name in entries]),
        Column("orders, left and right", orders),
        Column("largest normalised residual", [number(w["cover_max"], 6) for w in weights]),
        Column("bounds every unit", [None if w["cover_max"] is None else w["cover_max"] <= 1 for w in weights]),
        Column("above the optimal bound (dB)", [entry["overbound_db_max"] for entry in weights]),
        Column("estimation noise in the spread (%)", [None if n is None else 100 * n["at_peak"] for n in noise]),
        Column("approximation error", [entry["misfit_max"] for entry in entries.values()]),
    ]
    return Section("uncertainty", "Uncertainty weights", [text], tables=[build("Weights", columns)], figure="weights")


def run(facts: Facts) -> Section:
    """Return times, versions, and where the settings are."""
    timing = facts.get("timing_s", {})
    times = [Column("stage", list(timing)), Column("seconds", [float(v) for v in timing.values()])]
    versions = [f"{name} {import_module(name).__version__}" for name in _PACKAGES]
    text = "metrics.json holds all numbers of this page, study.json all settings. Software: "
    text += f"{', '.join(versions)} and Python {platform.python_version()}."
    return Section("run", "Run", [text], tables=[build("Time; a stage that was up to date counts in full", times)])
