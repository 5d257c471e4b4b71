"""The certificate of the observers as they run, over simulated populations: how often it is found, and whether an adversary ever exceeds it.

    python benchmarks/relift.py --seeds 0 1 2 3 4 5 6 7 8 9 --loop stiff soft --spread 1 3 --cache runs/relift

Prints one JSON line a population, then what holds over all of them. Studies run up to the synthesis of their observers and are kept in the
cache, so that work on the certificate repeats quickly; `--only-studies` stops there. Every observer is attacked with at least `--steps` simulated
steps by `attack` (energy gain of the error system, slopes and disturbances chosen against it), and, as it runs, by `attack_running`. Shares are of what the
certificate allows: above one it would be refuted.
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

import numpy as np

import kros
from kros.core.artifacts import read_json, write_json
from kros.core.work import Work
from kros.data import EpisodeBatch, write_parquet
from kros.data.readers.parquet import read_parquet
from kros.design.methods import methods_of
from kros.design.synthesize import _design, tasks_of
from kros.observer import Observer, ReliftScales, relift_certificate
from kros.observer.residual import one_step_residual
from kros.plants import HarmonicDrivePopulation
from kros.study import validate_config
from kros.study.config import Stage
from kros.study.engine.context import Context
from kros.study.engine.executors import open_executor
from kros.study.engine.store import Store

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from adversary import attack, attack_running
from frozen import compared

KINDS = ("koopman", "linear")
STUDY: dict[str, Any] = {
    "uncertainty": {"n_freqs": 300},
    "synthesis": {"methods": ["worst_case_h2", "residual_h2"]},
    "observer": {"baselines": ["open_loop", "kalman_tuned"]},
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
    parser.add_argument("--only-studies", action="store_true", help="make the studies and stop")
    parser.add_argument("--no-studies", action="store_true", help="take what the cache has")
    options = parser.parse_args()
    rows = []
    for seed, loop, spread in product(options.seeds, options.loop, options.spread):
        folder = options.cache / f"{loop}-{spread:g}-{seed}"
        if options.no_studies and not (folder / "run" / "observers" / "made.json").exists():
            continue
        start = time.perf_counter()
        run = study(folder, seed, loop, spread, options)
        told: dict[str, Any] = {
            "loop": loop,
            "spread": spread,
            "seed": seed,
            "study_s": round(time.perf_counter() - start, 1),
        }
        if not options.only_studies:
            found = certified(folder, run, options)
            rows.append(found)
            told |= found
        tell(told)
    if rows:
        tell(summary(rows))


def study(folder: Path, seed: int, loop: str, spread: float, options: argparse.Namespace) -> Path:
    """Return the run folder of one population, from the cache where it is there; observers of the refined models only."""
    recordings, run = folder / "recordings", folder / "run"
    if not (run / "observers" / "made.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        sizes = options.units, options.episodes, options.seconds, seed
        drives = HarmonicDrivePopulation(*sizes, spread=spread, outlier=False, loop=loop)
        write_parquet(drives.simulate().population, recordings)
        config = validate_config({**STUDY, "data": {"source": str(recordings.absolute()), "reader": "parquet"}}, folder)
        kros.run(config, run, until=Stage.QUANTIFY, workers=options.workers)
        with open_executor(options.workers) as executor:
            context = Context(config, Store(run), Work(executor))
            wanted = {*config.observer.baselines, *config.synthesis.methods}
            tasks = [
                task
                for kind in KINDS
                for task in tasks_of(context.uncertain, kind, methods_of(wanted, config.estimator))
            ]
            made = []
            for task, product in zip(tasks, context.work.map("synthesize", _design, tasks), strict=True):
                if not isinstance(product, str):
                    product.observer.save(run / "observers" / f"{task.name}.json")
                made.append([task.name, product if isinstance(product, str) else None])
        write_json(run / "observers" / "made.json", made)
    return run


def certified(folder: Path, run: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Certify and attack every observer of one population."""
    config = validate_config(
        {**STUDY, "data": {"source": str((folder / "recordings").absolute()), "reader": "parquet"}}, folder
    )
    with open_executor(1) as executor:
        context = Context(config, Store(run), Work(executor))
        facts, calibration, population = (
            context.facts,
            context.identified.calibration,
            read_parquet(folder / "recordings"),
        )
        keys = [facts.keys("train", unit, facts.identify_on)[0] for unit in facts.pooled]
        units = (
            {}
            if calibration is None
            else {unit: {"phase": phase.phase_rad} for unit, phase in calibration.units.items()}
        )
        batch = EpisodeBatch.read(population, keys, parameters=units)
    noise = np.array([facts.resolution["position"] / np.sqrt(12)])
    found = {}
    for name, reason in read_json(run / "observers" / "made.json"):
        if reason is not None:
            found[name] = {"reason": reason}
            continue
        observer = Observer.load(run / "observers" / f"{name}.json")
        values = batch.parameters if observer.lifting.parameters else None
        found[name] = judged(observer, batch, values, noise, options)
    return found


def judged(
    observer: Observer, batch: EpisodeBatch, values: Any, noise: np.ndarray, options: argparse.Namespace
) -> dict[str, Any]:
    """Return what is certified about one observer, how close its errors come, and how close the adversary does."""
    residual = one_step_residual(observer.lifting, observer.A, observer.B, batch.states, batch.inputs, values)
    scales = ReliftScales.typical(np.abs(batch.states).max(axis=(0, 1)), residual, noise)
    start = time.process_time()
    certificate = relift_certificate(observer, scales=scales)
    told: dict[str, Any] = {
        "states": observer.lifting.n_states + observer.controller.n_states,
        "cpu_s": round(time.process_time() - start, 3),
    }
    if certificate.gain is None:
        return told | {"certified": False, "reason": certificate.reason}
    rows = compared(certificate, observer, batch)
    start = time.process_time()
    worst = attack(certificate, observer, steps=options.steps)
    share, steps = attack_running(certificate, observer, worst.disturbance, batch.states[0], batch.inputs, values)
    told |= {
        "certified": True,
        "gain": certificate.gain,
        "lower_bound": certificate.lower_bound,
        "error_of_bound": [r.error / r.bound for r in rows],
    }
    told |= {
        "attack": worst.share,
        "attack_running": share,
        "steps": worst.steps + steps,
        "attack_s": round(time.process_time() - start, 2),
    }
    return {key: rounded(value) for key, value in told.items()}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what holds over all populations, observer by observer."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    told: dict[str, Any] = {"populations": len(rows)}
    for name in names:
        made = [row[name] for row in rows if name in row and "reason" not in row[name]]
        tried = [row[name] for row in rows if name in row and "cpu_s" in row[name]]
        told[name] = {"made": len(tried), "certified": len(made)}
        if made:
            told[name] |= {
                "gain_over_lower_bound_max": rounded(max(m["gain"] / m["lower_bound"] for m in made)),
                "attack_share": [rounded(f([m["attack"] for m in made])) for f in (min, max)],
                "attack_running_share": [rounded(f([m["attack_running"] for m in made])) for f in (min, max)],
                "error_of_bound": [
                    rounded(f([v for m in made for v in m["error_of_bound"]])) for f in (min, np.median, max)
                ],
                "states_max": max(m["states"] for m in made),
                "cpu_s_max": max(m["cpu_s"] for m in made),
                "steps_min": min(m["steps"] for m in made),
            }
    return told


def rounded(value: Any) -> Any:
    """Return numbers with six digits."""
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float | np.floating) else value


def tell(row: dict[str, Any]) -> None:
    """Print one line."""
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
