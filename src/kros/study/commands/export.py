"""A run's observer as C99 source, or as a functional mock-up unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core.artifacts import load_artifact
from ...core.errors import ConfigError
from ...export import LoadOutput, export_c, export_fmu
from ...motor_drive import AngleLoad
from ...observer import Observer
from ..config import Stage
from ..engine.run_folder import open_finished

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
    """Write one of a run's observers as C source, or as an FMU of a version; `name` is the study's by default.

    The parameter `track` is followed by a phase-locked loop; observers of a load torque, ``koopman/load``, give its level too.

    Raises
    ------
    ConfigError
        When there is no such observer, or no such run.
    """
    with open_finished(run, Stage.READ, Stage.SYNTHESIZE) as (config, store):
        names = (DEPLOYED, *load_artifact(store.path("observers"), "observers")[0]["names"])
        loads = {f"{kind}/{LOAD}": f"{kind}.json" for kind in ("koopman", "linear") if store.holds(LOAD, f"{kind}.json")}
        if observer not in (*names, *loads):
            raise ConfigError(f"Run {run}: has no observer {observer!r}; known are {', '.join((*names, *loads))}.")
        path = store.path(LOAD, loads[observer]) if observer in loads else store.path("observers", f"{observer}.json")
        chosen, name = Observer.load(path), name or identifier(config.name)
        if fmi is not None:
            return export_fmu(chosen, out, fmi, name, precision, track)
        limit = np.inf if config.load.limit is None else config.load.limit
        level = AngleLoad(config.load.level_s, chosen.sample_period_s, limit=limit)
        load = LoadOutput(level, current=config.load.current) if observer in loads else None
        return export_c(chosen, out, name, precision, config.dump(), track, load)


def identifier(text: str) -> str:
    """Return a C identifier that looks like a study's name."""
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in text).strip("_") or "observer"
    return plain if plain[0].isalpha() else f"observer_{plain}"
