"""Mixed synthesis over simulated populations: does it always give a verified observer, how good is it, how long does it take.

    python benchmarks/mixed.py --seeds 0 1 2 3 4 5 6 7 8 9 --loop stiff soft --keep populations/

A line for each population and kind of model: status, states before and after reduction, seconds, norms, the certified worst case against open
loop, and the error of the deployed observer on training episodes against open loop (percent of each channel's range). With ``--keep`` identified
populations stay in that folder and are read from there the next time; ``--refine`` adds the refined models, which takes minutes a population;
``--run`` uses finished runs of a study instead of simulating.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

import kros
from kros.core import KrosError, gain
from kros.core.artifacts import read_json
from kros.core.work import Work
from kros.data import write_parquet
from kros.design.methods.gains import OpenLoop
from kros.design.methods.robust import Mixed
from kros.design.synthesize import tasks_of
from kros.design.task import DesignTask
from kros.design.training import percent_of
from kros.plants import HarmonicDrivePopulation
from kros.study import validate_config
from kros.study.config import Stage
from kros.study.engine.context import Context
from kros.study.engine.executors import open_executor
from kros.study.engine.store import Store
from kros.synthesis.problem.plants import mixed_plant
from kros.synthesis.worst_case.certificate import certify_errors


def main() -> None:
    """Make or read the populations, print a line for each kind of model, and a summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--loop", choices=["stiff", "soft"], nargs="+", default=["stiff", "soft"])
    parser.add_argument("--units", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--refine", action="store_true")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--run", type=Path, nargs="+", default=[])
    options = parser.parse_args()
    seconds, failures, kinds = [], 0, 0
    with tempfile.TemporaryDirectory() as scratch:
        named = [(run.name, run) for run in options.run] or populations(options.keep or Path(scratch), options)
        for label, folder in named:
            for task in tasks(folder):
                kinds += 1
                line, used, failed = solve(task)
                seconds.append(used)
                failures += failed
                sys.stdout.write(f"{label:14s} {task.models.name:13s} {line}\n")
                sys.stdout.flush()
    sys.stdout.write(
        f"{kinds} problems, {failures} failures; median {np.median(seconds):.2f} s, worst {max(seconds):.2f} s of this process\n"
    )


def populations(root: Path, options: argparse.Namespace) -> Iterator[tuple[str, Path]]:
    """Simulate and identify populations, one after the other."""
    for loop, seed in product(options.loop, options.seeds):
        label = f"{loop}-{seed}" + ("-refined" if options.refine else "")
        out, recordings = root / label, root / label / "recordings"
        if not (out / "run" / "metrics.json").exists():
            drives = HarmonicDrivePopulation(options.units, options.episodes, 20.0, seed, loop=loop)
            write_parquet(drives.simulate().population, recordings)
            config = validate_config(
                {"data": {"source": str(recordings), "reader": "parquet"}, "identify": {"refine": options.refine}}, root
            )
            kros.run(config, out / "run", until=Stage.QUANTIFY, workers=options.workers)
        yield label, out / "run"


def tasks(folder: Path) -> list[DesignTask]:
    """Return a synthesis task for every kind of model of a run."""
    config = validate_config(read_json(folder / "study.json"), folder)
    with open_executor(1) as executor:
        context = Context(config, Store(folder), Work(executor))
        found = context.uncertain
        first = [tasks_of(found, kind, [OpenLoop()])[0] for kind in found.models.kinds]
        return [replace(task, name=f"{task.models.name}/mixed", method=Mixed()) for task in first]


def solve(task: DesignTask) -> tuple[str, float, bool]:
    """Synthesise one observer; return what to print, the processor seconds, and whether it failed."""
    if task.problem is None:
        return f"no usable set: {task.refusal}", 0.0, True
    n_states = mixed_plant(task.problem).sizes[0]
    wall, start = time.perf_counter(), time.process_time()
    try:
        result = task.method.design(task)
    except KrosError as error:
        return (
            f"{n_states:2d} states FAILED after {time.perf_counter() - wall:.2f} s: {error}",
            time.process_time() - start,
            True,
        )
    wall, used = time.perf_counter() - wall, time.process_time() - start
    judge, found = task.training.read(), result.synthesis
    problem, models = replace(task.problem, injection=found.injection), task.models
    idle = gain(np.zeros((models.lifting.n_lifted, len(models.measured))), models.sample_period_s)
    nothing = certify_errors(problem, problem.error_system(idle))
    error, free = percent_of([result.observer, task.observer(task.open_loop())], judge)
    return (
        f"{n_states:2d} states, K {found.controller.n_states:2d} {found.status.value:10s} {used:6.2f} s ({wall:6.2f} s wall) "
        f"H2 {found.h2_norm:.4g} Hinf {found.hinf_norm:.4f} worst case {found.worst_case_h2:.4g} (open {nothing:.4g}) "
        f"error {np.array2string(error, precision=3)} (open {np.array2string(free, precision=3)})",
        used,
        False,
    )


if __name__ == "__main__":
    main()
