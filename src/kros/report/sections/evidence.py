"""Where the numbers come from: recordings, models, spread of the units, weights, the run."""

import math
import platform
from importlib import import_module

from ...core.linalg import radius_text
from ...data import OUTLIERS, some
from ..content import Column, Row, Section, build
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
    aside = [row["unit"] for row in facts.get("units") if row.get("group") == OUTLIERS]
    text += f" Set aside as outliers: {some(aside)}." if aside else ""
    text += f" Dropped for bad samples: {some(study['dropped'])}." if study.get("dropped") else ""
    steps = study.get("resolution", {})
    roles = dict.fromkeys(study.get("inputs", ()), "input") | dict.fromkeys(facts.measured, "measured")
    rows = [
        {"channel": words(c), "unit": unit or "–", "role": roles.get(c, "estimated"), "resolution": steps.get(c)}
        for c, unit in study.get("channels", {}).items()
    ]
    table = build("Channels", [Column(key) for key in rows[0]], rows) if rows else None
    return Section("recordings", "Recordings", [text], tables=[table], figure="signals")


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
    return Section("calibration", "Phase calibration", [text], figure="phase")


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
    rows, columns = list[Row](), [Column(title) for title in ("model", "states", "largest pole")]
    for name, entry in entries.items():
        pole, errors = minus(radius_text(entry["spectral_radius_max"])), entry.get("freerun_error_percent", {})
        known = {(channel, what): error for channel, of in errors.items() for what, error in of.items()}
        rows.append({"model": model_label(name), "states": entry["order"], "largest pole": pole, **known})
    for channel, what in dict.fromkeys(key for row in rows for key in row if isinstance(key, tuple)):
        columns.append(Column(f"{what} (%)", (channel, what), words(channel), best=True))
    caption = "Simulation of held-out episodes from their first state, error in percent of the largest value"
    return Section("models", "Models", [text], tables=[build(caption, columns, rows)], figure="free_run")


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
    rows = [
        {
            "form": words(form),
            "used": "used" if form == first["form"] else "",
            **{name: entry["peak_db"][form] for name, entry in entries.items()},
        }
        for form in first["peak_db"]
    ]
    columns = [Column("form", note="used"), *(Column(f"{model_label(name)} (dB)", name) for name in entries)]
    table = build("Peak residual, with the nominal unit that suits each form best", columns, rows, words(first["form"]))
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
    rows = []
    for name, entry in entries.items():
        weight, noise = entry["weight"], entry.get("noise_share")
        rows.append(
            {
                "model": model_label(name),
                "orders, left and right": " and ".join(", ".join(map(str, side)) for side in weight["orders"]),
                "largest normalised residual": number(weight["cover_max"], 6),
                "above the optimal bound (dB)": weight["overbound_db_max"],
                "estimation noise in the spread (%)": noise and 100 * noise["at_peak"],
                "approximation error": entry["misfit_max"],
            }
        )
    table = build("Weights", [Column(title) for title in rows[0]], rows)
    return Section("uncertainty", "Uncertainty weights", [text], tables=[table], figure="weights")


def run(facts: Facts) -> Section:
    """Return times, versions, and where the settings are."""
    times = [{"stage": stage, "seconds": float(seconds)} for stage, seconds in facts.get("timing_s").items()]
    table = build("Time; a stage that was up to date counts in full", [Column("stage"), Column("seconds")], times)
    versions = [f"{name} {import_module(name).__version__}" for name in _PACKAGES]
    text = "metrics.json holds all numbers of this page, study.json all settings. Software: "
    text += f"{', '.join(versions)} and Python {platform.python_version()}."
    return Section("run", "Run", [text], tables=[table])
