"""Refined models against the paper's recipe over simulated populations: accuracy on held-out episodes, and what it costs in uncertainty.

    python benchmarks/refinement.py --seeds 10 11 12 13 14 --loop stiff soft --spread 1 3

Prints one JSON line a population. Free-run errors are medians over the units, in percent of the episode's range; ratios are against
`koopman_edmd` of the same run, `koopman_to_linear` is the current error of the refined Koopman models against the refined linear ones.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import kros
from kros.core.norms import hinf_norm
from kros.core.work import Work
from kros.data import write_parquet
from kros.identify import ModelSet, free_run
from kros.plants import HarmonicDrivePopulation
from kros.study import validate_config
from kros.study.config import Stage
from kros.study.engine.context import Context
from kros.study.engine.executors import open_executor
from kros.study.engine.store import Store
from kros.uncertainty import UncertainModel


def main() -> None:
    """Run the studies and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12, 13, 14])
    parser.add_argument("--loop", choices=["stiff", "soft"], nargs="+", default=["stiff", "soft"])
    parser.add_argument("--spread", type=float, nargs="+", default=[1.0, 3.0])
    parser.add_argument("--units", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    for loop, spread, seed in product(options.loop, options.spread, options.seeds):
        with tempfile.TemporaryDirectory() as folder:
            row = {"loop": loop, "spread": spread, "seed": seed, **study(Path(folder), seed, loop, spread, options)}
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()


def study(folder: Path, seed: int, loop: str, spread: float, options: argparse.Namespace) -> dict[str, Any]:
    """Simulate one population, identify and quantify it, return the facts."""
    recordings, out = folder / "recordings", folder / "run"
    drives = HarmonicDrivePopulation(options.units, options.episodes, 20.0, seed, spread=spread, loop=loop)
    write_parquet(drives.simulate().population, recordings)
    raw = {"data": {"source": str(recordings), "reader": "parquet"}, "identify": {"refine": True}}
    config = validate_config(raw, folder)
    metrics = kros.run(config, out, until=Stage.QUANTIFY, workers=options.workers).metrics
    with open_executor(1) as executor:
        return facts(Context(config, Store(out), Work(executor)), metrics)


def facts(context: Context, metrics: dict[str, Any]) -> dict[str, Any]:
    """Return errors, ratios and weights of one study."""
    identified = context.identified
    sets = {name: identified.models(name) for name in identified.kinds + identified.edmd_kinds}
    errors = {name: percent(context, models) for name, models in sets.items()}
    middle = {name: np.median(e, axis=0) for name, e in errors.items()}
    found: dict[str, Any] = {
        "identify_s": round(metrics["timing_s"]["identify"], 1),
        "quantify_s": round(metrics["timing_s"]["quantify"], 1),
    }
    found |= {name: rounded(value) for name, value in middle.items()}
    found["ratio"] = rounded(middle["koopman"] / middle["koopman_edmd"])
    found["koopman_to_linear"] = round(float(middle["koopman"][-1] / middle["linear"][-1]), 3)
    for name in ("koopman", "linear"):
        uncertain = UncertainModel.load(context.store.path("uncertainty", name))
        weight = metrics["uncertainty"][name]["weight"]
        found[f"{name}/weight"] = {
            "peak_db": round(float(metrics["uncertainty"][name]["peak_db"]["inverse_input_multiplicative"]), 2),
            "fitted_db": round(20 * np.log10(hinf_norm(uncertain.weight.right @ uncertain.weight.left)), 2),
            "overbound_db": round(weight["overbound_db_max"], 2),
        }
    return found


def percent(context: Context, models: ModelSet) -> np.ndarray:
    """Return the free-run error of every unit on its held-out episodes, shape (unit, n)."""
    calibration = context.identified.calibration
    out = np.zeros((len(models.unit_ids), models.lifting.n_states))
    for row, unit in enumerate(models.unit_ids):
        parts = [
            context.population.read_parts(key) for key in context.facts.keys("test", unit, context.facts.identify_on)
        ]
        x, u = np.stack([p[0] for p in parts]), np.stack([p[1] for p in parts])
        own = (
            {}
            if not models.lifting.parameters or calibration is None
            else {"phase": np.full(len(x), calibration.units[unit].phase_rad)}
        )
        run = free_run(models.A[row], models.B[row], models.lifting, own, x[:, 0], u)
        out[row] = np.mean(100 * np.sqrt(np.mean((run - x) ** 2, axis=1)) / np.abs(x).max(axis=1), axis=0)
    return out


def rounded(values: np.ndarray) -> list[float]:
    """Return plain numbers with three decimals."""
    return [round(float(v), 3) for v in values]


if __name__ == "__main__":
    main()
