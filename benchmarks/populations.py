"""Whole studies over several simulated populations: what holds for one seed should hold for all.

    python benchmarks/populations.py --seeds 0 1 2 3 4 --loop stiff

Prints one line a population: errors of the deployed observer against open loop and the tuned Kalman filter (mean over the units, first
condition identified on), the weight's soundness, and the outlier scores when the planted unit is filed as an ordinary one.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import kros
from kros.data import write_parquet
from kros.plants import HarmonicDrivePopulation
from kros.study import validate_config

PLANTED = "000000"


def main() -> None:
    """Run the studies and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--loop", choices=["stiff", "soft"], default="stiff")
    parser.add_argument("--spread", type=float, default=1.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--hide", action="store_true", help="file the planted unit as an ordinary one")
    options = parser.parse_args()
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            print(
                json.dumps(
                    {"seed": seed, "loop": options.loop, "hidden": options.hide, **study(Path(folder), seed, options)}
                ),
                flush=True,
            )


def study(folder: Path, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Simulate one population, run the study, return the facts."""
    recordings = folder / "recordings"
    drives = HarmonicDrivePopulation(12, 10, 20.0, seed, spread=options.spread, loop=options.loop)
    write_parquet(drives.simulate().population, recordings)
    if options.hide:
        hide(recordings)
    config = validate_config({"name": "population", "data": {"source": str(recordings), "reader": "parquet"}}, folder)
    metrics = kros.run(config, folder / "run", workers=options.workers).metrics
    shutil.rmtree(recordings)
    return facts(metrics)


def hide(recordings: Path) -> None:
    """File the planted unit under the population."""
    index = recordings / "population.json"
    content = json.loads(index.read_text())
    for unit in content["units"]:
        unit["group"] = "population"
    index.write_text(json.dumps(content))


def facts(metrics: dict[str, Any]) -> dict[str, Any]:
    """Return what the acceptance of a population looks at."""
    on = metrics["study"]["identify_on"]
    rows = [r for r in metrics["evaluation"] if r["condition"] == on and r["unit"] != PLANTED]
    found: dict[str, Any] = {"seconds": round(metrics["timing_s"]["total"], 1)}
    for model in metrics["models"]:
        for method in ("worst_case_h2", "kalman_tuned", "open_loop", "mixed"):
            name = f"{model}/{method}"
            errors = {
                c: [r["error_percent"] for r in rows if (r["observer"], r["channel"]) == (name, c)]
                for c in ("position", "velocity", "current")
            }
            found[name] = {c: round(sum(v) / len(v), 6) for c, v in errors.items() if v} or metrics["observers"][
                name
            ].get("reason")
        weight = metrics["uncertainty"][model]["weight"]
        found[f"{model}/weight"] = {k: weight[k] for k in ("cover_max", "overbound_db_max", "orders")}
    loaded = sorted((r for r in metrics["outliers"] if r["condition"] == "load"), key=lambda r: -r["score"])
    found["top_loaded"] = [(r["unit"], round(r["score"], 2)) for r in loaded[:2]]
    found["flagged"] = [(r["unit"], r["condition"]) for r in metrics["outliers"] if r["outlier"]]
    return found


if __name__ == "__main__":
    main()
