"""A run's observer as C99 source, or as a functional mock-up unit."""

from __future__ import annotations

from pathlib import Path

from ...core.artifacts import load_artifact
from ...core.errors import ConfigError
from ...export import export_c, export_fmu
from ...observer import Observer
from ..config import Stage
from ..engine.run_folder import open_finished

DEPLOYED = "deployed"


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
    """Write one of a run's observers as C source, or as an FMU of a version; `name` is the study's by default; `track` is followed.

    Raises
    ------
    ConfigError
        When there is no such observer, or no such run.
    """
    with open_finished(run, Stage.READ, Stage.SYNTHESIZE) as (config, store):
        names = load_artifact(store.path("observers"), "observers")[0]["names"]
        if observer not in (DEPLOYED, *names):
            raise ConfigError(f"Run {run}: has no observer {observer!r}; known are {', '.join((DEPLOYED, *names))}.")
        chosen, name = Observer.load(store.path("observers", f"{observer}.json")), name or identifier(config.name)
        if fmi is not None:
            return export_fmu(chosen, out, fmi, name, precision, track)
        return export_c(chosen, out, name, precision, config.dump(), track)


def identifier(text: str) -> str:
    """Return a C identifier that looks like a study's name."""
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in text).strip("_") or "observer"
    return plain if plain[0].isalpha() else f"observer_{plain}"
