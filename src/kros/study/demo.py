"""Simulated recordings on disk, and the whole study on them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from ..core.artifacts import write_json
from ..core.errors import ConfigError
from ..data import write_parquet, write_raw
from .config import validate_config
from .context import Progress
from .pipeline import RunResult, run_study
from .presets import HARMONIC_DRIVE

FORMATS = ("parquet", "raw")
_MARK = "demo.json"


def simulate_to(
    out: Path, plant: str, units: int, episodes: int, seconds: float, seed: int, spread: float, loop: str, outlier: bool, format_: str
) -> dict[str, Any]:
    """Simulate a population into a new folder, with the truth beside it in ``truth.json``.

    Returns
    -------
    dict
        The truth that was written.
    """
    from ..plants import PLANTS

    for name, value, allowed in (("--plant", plant, tuple(PLANTS)), ("--format", format_, FORMATS), ("--loop", loop, ("stiff", "soft"))):
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


def run_demo(out: Path, units: int, episodes: int, seconds: float, seed: int, workers: int, progress: Progress) -> RunResult:
    """Simulate a population with one badly assembled drive and run the study on it, all below one folder.

    Raises
    ------
    ConfigError
        When the folder holds anything but an earlier demo.
    """
    out = Path(out).absolute()
    if out.exists():
        if not out.is_dir() or (any(out.iterdir()) and not (out / _MARK).exists()):
            raise ConfigError(f"Output {out}: holds something that is not an earlier demo; name another folder.")
        shutil.rmtree(out)
    recordings = out / "simulated"
    progress.start("simulate", None)
    out.mkdir(parents=True)
    write_json(out / _MARK, {"schema": 1, "units": units, "episodes": episodes, "seconds": seconds, "seed": seed})
    write_json(out / "study.json", {})
    simulate_to(recordings, "harmonic-drive", units, episodes, seconds, seed, 1.0, "stiff", True, "parquet")
    config = validate_config({"name": "demo", "data": {"source": str(recordings), "reader": "parquet"}}, out)
    return run_study(config, out, workers=workers, progress=progress)
