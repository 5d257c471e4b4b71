"""The certificate of the observers as they run, over simulated populations: how often it is found, and whether an adversary ever exceeds it.

    python benchmarks/relift.py --seeds 0 1 2 3 4 5 6 7 8 9 --loop stiff soft --spread 1 3 --cache runs/relift

Prints one JSON line a population, then what holds over all of them. Studies run up to the synthesis of their observers and are kept in the
cache, so that work on the certificate repeats quickly; `--only-studies` stops there. Every observer is attacked with at least `--steps` simulated
steps by `attack` (energy gain of the error system, slopes and disturbances chosen against it), and, as it runs, by `attack_running`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from itertools import product
from pathlib import Path
from typing import Any

from kros.core.artifacts import write_json
from kros.study import run_study, validate_config
from kros.study.config import Stage
from kros.study.context import Context, Silent
from kros.study.demo import simulate_to
from kros.study.executors import open_executor
from kros.study.makers import produce
from kros.study.stages.synthesize import tasks_of
from kros.study.store import Store

KINDS = ("koopman", "linear")
STUDY: dict[str, Any] = {
    "uncertainty": {"n_freqs": 300},
    "synthesis": {"methods": ["worst_case_h2", "residual_h2"]},
    "observer": {"baselines": ["open_loop", "kalman_white"]},
}


def main() -> None:
    """Make the studies and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--loop", choices=["stiff", "soft"], nargs="+", default=["stiff", "soft"])
    parser.add_argument("--spread", type=float, nargs="+", default=[1.0, 3.0])
    parser.add_argument("--units", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("runs/relift"))
    parser.add_argument("--only-studies", action="store_true")
    options = parser.parse_args()
    for seed, loop, spread in product(options.seeds, options.loop, options.spread):
        start = time.perf_counter()
        run = study(options.cache / f"{loop}-{spread:g}-{seed}", seed, loop, spread, options)
        tell({"loop": loop, "spread": spread, "seed": seed, "study": run.name, "study_s": round(time.perf_counter() - start, 1)})


def study(folder: Path, seed: int, loop: str, spread: float, options: argparse.Namespace) -> Path:
    """Return the run folder of one population, from the cache where it is there; observers of the refined models only."""
    recordings, run = folder / "recordings", folder / "run"
    if not (run / "observers" / "made.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        simulate_to(recordings, "harmonic-drive", options.units, options.episodes, options.seconds, seed, spread, loop, False, "parquet")
        config = validate_config({**STUDY, "data": {"source": str(recordings.absolute()), "reader": "parquet"}}, folder)
        run_study(config, run, until=Stage.QUANTIFY, workers=options.workers)
        with open_executor(options.workers) as executor:
            context = Context(config, Store(run), executor, Silent())
            tasks = [task for kind in KINDS for task in tasks_of(context, kind)]
            made = []
            for task, product in zip(tasks, context.map("synthesize", produce, tasks), strict=True):
                if product.synthesis is not None:
                    task.observer(product.synthesis).save(run / "observers" / f"{task.name}.json")
                made.append([task.name, product.facts.get("reason")])
        write_json(run / "observers" / "made.json", made)
    return run


def tell(row: dict[str, Any]) -> None:
    """Print one line."""
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
