"""Accuracy against the quality of the sensor: observers that were told of it, and those that were not.

    python benchmarks/sensor.py FOLDER --loop stiff --seed 301

Simulates twelve drives of spread 3, identifies and quantifies eight of them (kept in FOLDER, where a second run finds them), and designs for every
sensor the estimator, the open loop, the tuned Kalman filter and the learned estimator. Prints errors on the held-out four, shown by that
sensor: percent of the largest value of velocity and current, mean over the units.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import kros
from kros.core.errors import SynthesisError
from kros.data import EpisodeBatch, write_parquet
from kros.design.baselines import make_learned
from kros.design.methods import methods_of
from kros.design.synthesize import tasks_of
from kros.design.training import TrainingSet
from kros.evaluate import error_percent
from kros.evaluate.sensor import as_shown
from kros.identify.calibration import segments_of
from kros.observer import EstimatorSettings, Sensor, run_observer
from kros.observer.units import in_sizes
from kros.plants import HarmonicDrivePopulation
from kros.uncertainty.quantify import UncertainModels

HIDDEN = (1, 2)
METHODS = ("open_loop", "kalman_tuned", "estimator")
Run = Callable[[EpisodeBatch], np.ndarray]


def sensors(size: float, step: float) -> dict[str, dict[str, float]]:
    """Return what is declared of the position's sensor, by name."""
    levels: dict[str, dict[str, float]] = {"as recorded": {}}
    levels |= {f"noise {s:g} of the range": {"noise": s * size} for s in (1e-6, 1e-5, 1e-4)}
    levels |= {f"{d} samples late": {"delay_samples": d} for d in (1, 2, 3)}
    levels |= {"10 times the resolution": {"resolution": 10 * step}}
    return levels | {f"{100 * p:g} % lost": {"dropout": p} for p in (0.05, 0.1)}


def prepared(folder: Path, loop: str, seed: int) -> tuple[UncertainModels, Any, list[str]]:
    """Return the uncertain models of eight units, the recordings of all and the names of the others."""
    if not (folder / "recordings").exists():
        drives = HarmonicDrivePopulation(12, 6, 12.0, seed, spread=3.0, outlier=False, loop=loop)
        write_parquet(drives.simulate().population, folder / "recordings")
    population = kros.read(folder / "recordings")
    units = [u.id for u in population.units]
    if not (folder / "uncertain").exists():
        models = kros.identify(population.select(units[:8]), lifting=["sin(100*position + phase)"])
        kros.quantify(models).save(folder / "uncertain")
    return UncertainModels.load(folder / "uncertain"), population, units[8:]


def held_out(uncertain: UncertainModels, population: Any, units: list[str]) -> EpisodeBatch:
    """Read the last two unloaded episodes of every unit, with its phase."""
    calibration = uncertain.models.calibration
    assert calibration is not None
    keys = {u: [k for k in population.episodes if (k.unit, k.condition) == (u, "noload")] for u in units}
    found = {
        u: calibration.calibrate(segments_of((population.select([u]), tuple(own), calibration.spec)), u)
        for u, own in keys.items()
    }
    phases = {u: {calibration.spec.parameter: phase.phase_rad} for u, phase in found.items()}
    return EpisodeBatch.read(population, [k for own in keys.values() for k in own[-2:]], parameters=phases)


def designs(uncertain: UncertainModels, sensor: dict[str, Sensor]) -> dict[str, Run]:
    """Design and train everything for a sensor."""
    found: dict[str, Run] = {}
    for task in tasks_of(uncertain, "koopman", methods_of(METHODS, EstimatorSettings()), sensor):
        with contextlib.suppress(SynthesisError):
            own = in_sizes(task.method.design(task).observer, {})
            found[task.method.name] = lambda b, o=own: run_observer(
                o, b.measurements(o.measured), b.inputs, b.parameters
            )  # type: ignore[misc]
    models = uncertain.models
    learned = make_learned(TrainingSet.whole(models, models.models(), sensor), models.models().measured)
    return found | {
        "learned": lambda b: learned.estimate(b.keys, b.measurements(learned.measured), b.inputs, b.parameters)
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--loop", default="stiff", choices=("stiff", "soft"))
    parser.add_argument("--seed", type=int, default=301)
    args = parser.parse_args()
    uncertain, population, units = prepared(args.folder, args.loop, args.seed)
    batch = held_out(uncertain, population, units)
    size, step = uncertain.models.sizes["position"], uncertain.models.facts.resolution["position"]
    untold: dict[str, Run] = {}
    print(
        "| sensor | estimator, told | untold | learned, told | untold | tuned Kalman, told | open loop |\n|"
        + "---|" * 7
    )
    for name, declared in sensors(size, step).items():
        sensor = {"position": Sensor(**declared)} if declared else {}  # type: ignore[arg-type]
        told = designs(uncertain, sensor)
        untold = untold or told
        shown = as_shown(batch, sensor, population.states)
        columns = (
            told["estimator"],
            untold["estimator"],
            told["learned"],
            untold["learned"],
            told["kalman_tuned"],
            told["open_loop"],
        )
        cells = []
        for run in columns:
            errors = error_percent(run(shown)[..., : len(population.states)], shown.states, shown.lengths)[:, HIDDEN]
            cells.append(", ".join(f"{v:.3g}" for v in errors.mean(axis=0)))  # two episodes a unit
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
