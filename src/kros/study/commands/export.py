"""A run's observer as C99 source, or as a functional mock-up unit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ...core.artifacts import load_artifact, write_json
from ...core.errors import ConfigError
from ...core.files import did_you_mean
from ...data.survey import RecordingFacts
from ...export import LoadOutput, export_c, export_fmu
from ...observer import Observer
from ..config import Stage
from ..engine.run_folder import open_finished
from ..stages.load import TrialSettings

DEPLOYED, LOAD = "deployed", "load"


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
        folder = export_c(chosen, out, name, precision, track, load)
        write_json(folder / "study.json", config.dump())
        return folder


def identifier(text: str) -> str:
    """Return a C identifier that looks like a study's name."""
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in text).strip("_") or "observer"
    return plain if plain[0].isalpha() else f"observer_{plain}"
