"""A run's observer as C99 source, or as a functional mock-up unit."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.artifacts import load_artifact, read_json, write_json
from ...core.errors import ConfigError, KrosError
from ...core.files import did_you_mean
from ...data import EpisodeBatch
from ...data.survey import RecordingFacts
from ...design.validation import spread
from ...evaluate.sensor import as_arriving
from ...export import HeldOut, LoadOutput, export_c, export_fmu
from ...observer import Observer
from ..config import Stage, StudyConfig
from ..engine.run_folder import open_finished
from ..engine.store import Store
from ..stages.load import TrialSettings
from ..stages.read import open_source
from .field import load_calibration

log = logging.getLogger(__name__)

DEPLOYED, LOAD = "deployed", "load"
_EPISODES, _SAMPLES = 8, 20_000  # that the numerical error is measured on


def export_run(
    run: Path,
    out: Path,
    name: str | None,
    observer: str = DEPLOYED,
    *,
    fmi: int | None = None,
    precision: str = "double",
    track: str | None = None,
) -> Path:
    """Write one of a run's observers as C source, or as an FMU of a version; `name` is the study's by default."""
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.SYNTHESIZE) as (config, store):
        names = (DEPLOYED, *load_artifact(store.path("observers"), "observers")[0]["names"])
        places = {name: store.path("observers", f"{name}.json") for name in names}
        loads = {
            f"{k}/{LOAD}": store.path(LOAD, f"{k}.json")
            for k in ("koopman", "linear")
            if store.holds(LOAD, f"{k}.json")
        }
        if observer not in (known := places | loads):
            hint = f"{did_you_mean(observer, known) or ';'} known are {', '.join(known)}"
            raise ConfigError(f"Run {run}: has no observer {observer!r}{hint}.")
        chosen, name = Observer.load(known[observer]), name or identifier(config.name)
        if not chosen.about:  # that of a load: its channels are those of the observer that is deployed
            about = Observer.load(places[DEPLOYED]).about
            chosen = replace(chosen, about={key: about[key] for key in ("units_of_measure", "columns") if key in about})
        if fmi is not None:
            return export_fmu(chosen, out, fmi, name, precision, track)
        settings, facts = TrialSettings(), RecordingFacts.load(store.path("population"))
        level = settings.level(chosen.sample_period_s, facts.limits)
        load = LoadOutput(level, current=settings.current) if observer in loads else None
        folder = export_c(chosen, out, name, precision, track, load, held_out(config, store, chosen))
        write_json(folder / "study.json", config.dump())
        return folder


def held_out(config: StudyConfig, store: Store, observer: Observer) -> HeldOut | None:
    """Return some of a run's held-out recordings; None where they are gone, or are not as they were."""
    facts, calibration = RecordingFacts.load(store.path("population")), load_calibration(store)
    try:
        population = open_source(config)
        units = {
            u: {} if calibration is None else {calibration.spec.parameter: calibration.units[u].phase_rad}
            for u in population.unit_ids
        }
        batch = EpisodeBatch.read(
            population, spread([k for k in facts.test if k.unit in units], _EPISODES), parameters=units
        )
    except (KrosError, KeyError) as error:
        log.warning("Numerical error: not measured, since the run's recordings cannot be read: %s", error)
        return None
    batch = batch.head(min(int(batch.lengths.min()), _SAMPLES))
    y = as_arriving(batch, observer.sensor, population.states).measurements(observer.measured)
    states = np.full((*y.shape[:2], len(observer.recorded)), np.nan)  # recordings hold no load
    for i, name in enumerate(observer.recorded):
        if name in population.states:
            states[..., i] = batch.states[..., population.states.index(name)]
    return HeldOut(y, batch.inputs, states, batch.parameters)


def numerical_error(folder: Path) -> str:
    """Return in words what an export's manifest says of it."""
    error = read_json(folder / "manifest.json")["numerical_error"]
    if error is None:
        return "numerical error: not measured"
    loss = ", ".join(f"{name} {value:+.3f} %" for name, value in error["loss_percent"].items() if value is not None)
    size = f"{error['difference']:.0e} of the estimates' size"
    return f"numerical error on {error['samples']} held-out samples: {size}; estimation errors {loss}"


def identifier(text: str) -> str:
    """Return a C identifier that looks like a study's name."""
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in text).strip("_") or "observer"
    return plain if plain[0].isalpha() else f"observer_{plain}"
