"""Simulated recordings on disk, and the whole study on them."""

import time
from collections.abc import Sequence
from pathlib import Path

from ...core import ByName, ConfigError, Progress, Work, digest_of, whole_folder, write_json
from ...data import write_parquet
from ...data.readers.motor_drive_raw import write_raw
from ...identify.presets import HARMONIC_DRIVE
from ..config import Stage, validate_config
from ..engine.executors import open_executor
from ..engine.store import code_key, open_run
from ..pipeline import RunResult, require_usable, run_in

_STAGE, _RECORDINGS = "simulate", "simulated"


def simulate_to(out: Path, plant: str, layout: str, settings: ByName) -> None:
    """Simulate a population into a new folder, with the truth beside it in ``truth.json``."""
    from ...plants import PLANTS

    for name, value, allowed in (("plant", plant, tuple(PLANTS)), ("format", layout, ("parquet", "raw"))):
        if value not in allowed:
            raise ConfigError(f"--{name} {value!r}: choose one of {', '.join(allowed)}.")
    if layout == "raw" and plant != HARMONIC_DRIVE:
        raise ConfigError(f"--format raw: is the layout of motor drives; write {plant} as parquet.")
    with whole_folder(out) as folder:
        simulated = PLANTS[plant](**settings).simulate()
        if layout == "raw":
            write_raw(simulated.raw, folder)
        else:
            write_parquet(simulated.population, folder)
        write_json(folder / "truth.json", simulated.truth.as_dict())


def run_demo(out: Path, settings: ByName, workers: int, progress: Progress, overrides: Sequence[str]) -> RunResult:
    """Simulate drives and run the study on them, all below one folder; what is there is not simulated again."""
    out = out.absolute()
    data = {"source": str(out / _RECORDINGS), "reader": "parquet"}
    config = validate_config({"name": "demo", "data": data}, out, overrides=overrides)
    digest = digest_of(code_key(), settings)
    with open_run(out, config) as store, open_executor(workers) as mapped:
        if (artefact := store.stored(digest)) is not None:
            store.add(_STAGE, artefact)
        else:
            progress.start(_STAGE, None)
            began = time.perf_counter()
            with store.drafting() as draft:
                simulate_to(draft.draft(_RECORDINGS), HARMONIC_DRIVE, "parquet", settings)
                draft.commit(_STAGE, digest, time.perf_counter() - began)
        require_usable(config, Stage.REPORT)
        return run_in(store, config, Stage.REPORT, Work(mapped, progress))
