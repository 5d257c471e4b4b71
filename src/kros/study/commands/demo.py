"""Simulated recordings on disk, and the whole study on them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from ...core.artifacts import write_json
from ...core.errors import ConfigError
from ...core.store import digest_of
from ...core.work import Progress
from ...data import write_parquet, write_raw
from ...identify.presets import HARMONIC_DRIVE
from ..config import Stage, validate_config
from ..engine.executors import open_executor
from ..engine.run_folder import open_run
from ..engine.store import Store, code_key
from ..pipeline import RunResult, require_usable, run_in

FORMATS = ("parquet", "raw")
_STAGE, _RECORDINGS = "simulate", "simulated"


def simulate_to(
    out: Path,
    plant: str,
    units: int,
    episodes: int,
    seconds: float,
    seed: int,
    spread: float,
    loop: str,
    outlier: bool,
    format_: str,
) -> dict[str, Any]:
    """Simulate a population into a new folder, with the truth beside it in ``truth.json``."""
    from ...plants import PLANTS

    for name, value, allowed in (
        ("--plant", plant, tuple(PLANTS)),
        ("--format", format_, FORMATS),
        ("--loop", loop, ("stiff", "soft")),
    ):
        if value not in allowed:
            raise ConfigError(f"{name} {value!r}: choose one of {', '.join(allowed)}.")
    if format_ == "raw" and plant != HARMONIC_DRIVE:
        raise ConfigError(f"--format raw: is the layout of motor drives; write {plant} as parquet.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"Output {out}: exists and is not an empty folder; name a new one.")
    settings: dict[str, Any] = {
        "n_units": units,
        "n_episodes": episodes,
        "seconds": seconds,
        "seed": seed,
        "spread": spread,
        "outlier": outlier,
    }
    simulated = PLANTS[plant](**settings, **({"loop": loop} if plant == HARMONIC_DRIVE else {})).simulate()
    if out.exists():
        out.rmdir()
    if format_ == "raw":
        write_raw(simulated.raw, out)
    else:
        write_parquet(simulated.population, out)
    truth: dict[str, Any] = simulated.truth.as_dict()
    write_json(out / "truth.json", truth)
    return truth


def run_demo(
    out: Path,
    units: int,
    episodes: int,
    seconds: float,
    seed: int,
    workers: int,
    progress: Progress,
    overrides: Sequence[str] = (),
) -> RunResult:
    """Simulate a population with one badly assembled drive and run the study on it, all below one folder."""
    out = Path(out).absolute()
    raw = {
        "name": "demo",
        "data": {"source": str(out / _RECORDINGS), "reader": "parquet"},
        "predictor": {"effort": "quick"},
    }
    config = validate_config(raw, out, overrides=overrides)
    with open_run(out, config) as store, open_executor(workers) as executor:
        _simulate_in(store, units, episodes, seconds, seed, progress, partial(executor.map, _load, range(workers)))
        require_usable(config, Stage.REPORT)
        return run_in(store, config, Stage.REPORT, executor, progress)


def _load(_: int) -> None:
    """In a worker: load what takes long to load and every study needs."""
    for name in ("kros.study.pipeline", "pyarrow.parquet", "scipy.optimize", "sympy"):
        import_module(name)


def _simulate_in(
    store: Store,
    units: int,
    episodes: int,
    seconds: float,
    seed: int,
    progress: Progress,
    meanwhile: Callable[[], object],
) -> None:
    """Simulate into a run folder, where the same simulation is not there already; workers get something to do meanwhile."""
    settings = ("harmonic-drive", units, episodes, seconds, seed, 1.0, "stiff", True, "parquet")
    digest = digest_of(code_key(), settings)
    if store.restore(_STAGE, digest) is not None:
        return
    meanwhile()
    progress.start(_STAGE, None)
    began = time.perf_counter()
    with store.drafting() as draft:
        simulate_to(draft.draft(_RECORDINGS), *settings)
        draft.commit(_STAGE, digest, time.perf_counter() - began)
