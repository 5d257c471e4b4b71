"""Every observer of a study against everything that may be wrong with its measurements, against the load, twice the load, and random machines.

    python benchmarks/robustness.py --loop stiff soft --seed 0

Simulates the demo's population, runs the study with ``evaluate.robustness = "all"`` (all observers and units, both conditions, 10 s of one
held-out episode), then simulates the same drives with twice the load and runs the observers on the same episode of these. Prints for every
population: the error of the velocity and the current at chosen severities and the severity at which the error doubles (geometric mean of both), mean
over the units, no load; the errors without, with and with twice the load; and members of the certified sets against the bounds.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kros.core.errors import KrosError
from kros.core.work import Work
from kros.data import EpisodeBatch, Population
from kros.evaluate import Kind, error_percent
from kros.evaluate.robustness import severity_of_growth
from kros.observer import run_observers
from kros.plants import HarmonicDrivePopulation
from kros.report.disturbances import AXES, curves
from kros.study import run_study, validate_config
from kros.study.commands.demo import simulate_to
from kros.study.engine.context import Context
from kros.study.engine.executors import open_executor
from kros.study.engine.store import Store
from kros.study.stages.evaluate import baseline_makers, load_observers
from kros.study.stages.together import alike

UNITS, EPISODES, SECONDS = 12, 10, 20.0
HIDDEN = ("velocity", "current")
CHOSEN = {
    Kind.DROPPED: (0.1, 0.5),
    Kind.GAP: (0.01, 0.1, 1.0),
    Kind.BIAS: (1e-4, 1e-3),
    Kind.QUANTISATION: (1e-5, 1e-4),
    Kind.NOISE: (1e-6, 1e-5, 1e-4),
    Kind.PHASE: (np.pi / 8, np.pi / 2, np.pi),
    Kind.DELAY: (1, 4, 16),
}


@dataclass(frozen=True)
class HeavyPopulation(HarmonicDrivePopulation):
    """The same drives, with a load of so many times inertia and moment."""

    load: float = 2.0

    def _units(self) -> Any:
        units, p = super()._units()
        return units, replace(p, load_inertia=self.load * p.load_inertia, load_moment=self.load * p.load_moment)


def main() -> None:
    """Run all populations and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loop", choices=["stiff", "soft"], nargs="+", default=["stiff", "soft"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--units", type=int, default=UNITS)
    parser.add_argument("--members", type=int, default=1000)
    parser.add_argument("--keep", type=Path, help="write metrics of every population below this folder")
    options = parser.parse_args()
    for loop in options.loop:
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            metrics, loads = study(Path(folder), loop, options)
            say(f"\n# {loop} loop, seed {options.seed}, {options.units} units ({time.perf_counter() - began:.0f} s)")
            show(metrics, loads)
            if options.keep:
                options.keep.mkdir(parents=True, exist_ok=True)
                (options.keep / f"{loop}.json").write_text(json.dumps({"metrics": metrics, "loads": loads}))


def study(folder: Path, loop: str, options: argparse.Namespace) -> tuple[dict[str, Any], dict[str, dict[str, list[float]]]]:
    """Run a study, and its observers on the same drives with twice the load; return metrics and errors by load and observer."""
    recordings, out = folder / "recordings", folder / "run"
    simulate_to(recordings, "harmonic-drive", options.units, EPISODES, SECONDS, options.seed, 1.0, loop, False, "parquet")
    raw = {
        "data": {"source": str(recordings), "reader": "parquet"},
        "evaluate": {"robustness": "all", "monte_carlo": options.members},
    }
    config = validate_config(raw, folder)
    metrics = run_study(config, out).metrics
    with open_executor(1) as executor:
        context = Context(config, Store(out), Work(executor))
        heavy = HeavyPopulation(options.units, EPISODES, SECONDS, options.seed, loop=loop, conditions=("load",)).simulate().population
        loads = {
            "none": errors_on(context, context.population, "noload"),
            "load": errors_on(context, context.population, "load"),
            "twice": errors_on(context, heavy, "load"),
        }
    return metrics, loads


def errors_on(context: Context, population: Population, condition: str) -> dict[str, list[float]]:
    """Return the mean error of every observer in velocity and current, and the worst unit's, on the last episode of every unit."""
    calibration = context.identified.calibration
    assert calibration is not None
    units = {u: {calibration.spec.parameter: calibration.units[u].phase_rad} for u in context.facts.pooled}
    last = {k.unit: k for k in population.episodes if k.condition == condition and k.unit in units}
    batch = EpisodeBatch.read(population, tuple(last.values()), parameters=units)
    parameters, states = batch.parameters, population.states
    rows = [states.index(c) for c in HIDDEN]
    found: dict[str, list[float]] = {}

    def note(name: str, estimate: np.ndarray) -> None:
        percent = error_percent(estimate[..., : len(states)], batch.states, batch.lengths)[:, rows]
        found[name] = [*percent.mean(axis=0).tolist(), *percent.max(axis=0).tolist()]

    for group in alike(load_observers(context).values()):
        y, values = batch.states[..., list(group[0].measured)], parameters if group[0].lifting.parameters else None
        for observer, estimate in zip(group, run_observers(group, y, batch.inputs, values), strict=True):
            note(observer.name, estimate)
    for name, make in baseline_makers(context, population, tuple(last.values())).items():
        try:
            note(name, make().run(batch, parameters))
        except KrosError as error:
            say(f"{name}: {error}")
    return found


def show(metrics: dict[str, Any], loads: dict[str, dict[str, list[float]]]) -> None:
    """Print the tables."""
    found = curves(metrics["robustness"], metrics["study"]["identify_on"])
    say(f"handed over: {metrics['study']['deployed']}")
    say("\nseverity at which the error doubles (unit of the metrics)")
    table(["observer", *(kind.value for kind in Kind)], [[name, *(doubled(found[name], kind) for kind in Kind)] for name in found])
    for channel in HIDDEN:
        say(f"\n{channel}, percent of the largest value, mean over the units")
        head = ["observer", "0", *(f"{kind.value} {s * AXES[kind].factor:.3g}" for kind, chosen in CHOSEN.items() for s in chosen)]
        table(head, [[name, *at_chosen(found[name], channel)] for name in found if channel in found[name][Kind.BIAS]])
    say("\nerror without load, with it, and with twice the load: velocity and current, mean and worst")
    head = ["observer", *(f"{load} {what}" for load in loads for what in ("v", "i", "v worst", "i worst"))]
    table(head, [[name, *(value for load in loads.values() for value in load[name])] for name in loads["none"]])
    say("\nmembers of the certified set, and the units, over the bound")
    shares = ("largest", "unit_worst", "noise")
    rows = [[r["observer"], r["bound"], *(r[key] / r["bound"] for key in shares), r["exceeded"]] for r in metrics["monte_carlo"]["sets"]]
    table(["observer", "bound", *shares, "exceeded"], rows)


def doubled(by_kind: dict[Kind, Any], kind: Kind) -> float:
    """Severity at which the geometric mean of the hidden states' errors doubles."""
    hidden = [curve for channel, curve in by_kind[kind].items() if channel in HIDDEN]
    with np.errstate(divide="ignore"):
        return severity_of_growth(hidden[0].severities, np.exp(np.mean([np.log(c.errors) for c in hidden], axis=0)))


def at_chosen(by_kind: dict[Kind, Any], channel: str) -> list[float]:
    """Errors without disturbance and at the chosen severities."""
    values = [float(by_kind[Kind.BIAS][channel].errors[0])]
    for kind, chosen in CHOSEN.items():
        curve = by_kind[kind][channel]
        values += [float(curve.errors[np.isclose(curve.severities, s)][0]) for s in chosen]
    return values


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table in Markdown."""
    say("| " + " | ".join(head) + " |")
    say("|" + "---|" * len(head))
    for row in rows:
        say("| " + " | ".join(v if isinstance(v, str) else (f"{v}" if isinstance(v, bool) else f"{v:.3g}") for v in row) + " |")


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
