"""Simulated recordings on disk, and the whole study on them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from ...core import ConfigError, Progress, digest_of, frozen, write_json
from ...data import write_parquet
from ...data.readers.motor_drive_raw import write_raw
from ...identify.presets import HARMONIC_DRIVE
from ..config import Stage, validate_config
from ..engine.executors import open_executor
from ..engine.store import code_key, open_run
from ..pipeline import RunResult, require_usable, run_in

_STAGE, _RECORDINGS = "simulate", "simulated"


@frozen
class Simulation:
    """A population to simulate, and the format of its recordings."""

    n_units: int
    n_episodes: int
    seconds: float
    seed: int
    outlier: bool = True
    plant: str = HARMONIC_DRIVE
    format: str = "parquet"


def simulate_to(out: Path, simulation: Simulation) -> None:
    """Simulate a population into a new folder, with the truth beside it in ``truth.json``."""
    from ...plants import PLANTS

    plant, raw = simulation.plant, simulation.format == "raw"
    for name, allowed in (("plant", tuple(PLANTS)), ("format", ("parquet", "raw"))):
        if (value := getattr(simulation, name)) not in allowed:
            raise ConfigError(f"--{name} {value!r}: choose one of {', '.join(allowed)}.")
    if raw and plant != HARMONIC_DRIVE:
        raise ConfigError(f"--format raw: is the layout of motor drives; write {plant} as parquet.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"Output {out}: exists and is not an empty folder; name a new one.")
    settings = {key: value for key, value in vars(simulation).items() if key not in ("plant", "format")}
    simulated = PLANTS[plant](**settings).simulate()
    if out.exists():
        out.rmdir()
    if raw:
        write_raw(simulated.raw, out)
    else:
        write_parquet(simulated.population, out)
    write_json(out / "truth.json", simulated.truth.as_dict())


def run_demo(
    out: Path, simulation: Simulation, workers: int, progress: Progress, overrides: Sequence[str]
) -> RunResult:
    """Simulate a population and run the study on it, all below one folder; what is there is not simulated again."""
    out = Path(out).absolute()
    data = {"source": str(out / _RECORDINGS), "reader": "parquet"}
    config = validate_config({"name": "demo", "data": data}, out, overrides=overrides)
    digest = digest_of(code_key(), simulation)
    with open_run(out, config) as store, open_executor(workers) as executor:
        if (artefact := store.stored(digest)) is not None:
            store.add(_STAGE, artefact)
        else:
            progress.start(_STAGE, None)
            began = time.perf_counter()
            with store.drafting() as draft:
                simulate_to(draft.draft(_RECORDINGS), simulation)
                draft.commit(_STAGE, digest, time.perf_counter() - began)
        require_usable(config, Stage.REPORT)
        return run_in(store, config, Stage.REPORT, executor, progress)
