"""Observers on measured drives that they do not know: every drive, or both of a build, left out of a study and estimated by what came out of it.

A study (`study.toml`, with any `--set` of `kros run`) is made once a fold, from the training episodes of all other drives. Its observers, the extended
Kalman filter of its first lifted model, a filtered difference, a regression on the past and a linear estimator run on every episode of the
drives that were left out, those in which the drive stands still excepted. Errors are in percent of the largest value of an episode.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import kros
from kros.core.artifacts import load_artifact
from kros.data import EpisodeBatch, Population, read, split_episodes
from kros.data.readers.csv_folder import CsvMapping
from kros.design.baselines import make_difference, make_extended, make_learned
from kros.design.training import TrainingSet
from kros.evaluate import error_percent, unit_interval
from kros.identify import ModelSet
from kros.lifting import Lifting
from kros.observer import Observer, Recordings, ReliftScales, identify_estimator, run_observer
from kros.observer.estimator.certificate import filter_certificate
from kros.study import Stage, StudyConfig, load_config

HERE = Path(__file__).parent
STILL_RAD = 0.05  # a drive that moves less stands still, and percent of its noise say nothing
SHOWN = ("velocity", "torque")


@dataclass(frozen=True)
class Row:
    """What one estimator did on one drive: mean errors of the states over its episodes, and what holds for it."""

    drive: str
    percent: np.ndarray
    states: int | None
    running: bool | None
    robust: bool | None


def main() -> None:
    """Run all folds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/double_pendulum_left_out"))
    parser.add_argument("--drives", nargs="+", help="leave out these alone")
    parser.add_argument("--builds", action="store_true", help="leave out both drives of a build at once")
    parser.add_argument(
        "--alone", action="store_true", help="without the other joint's motion as inputs: the commanded torque alone"
    )
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help="as for kros run"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if "KROS_DATA" not in os.environ:
        sys.exit("Set KROS_DATA to the folder that holds dfki_double_pendulum; study.toml says where it is published.")
    settings = [f"data.source={Path(os.environ['KROS_DATA']) / 'dfki_double_pendulum'}", *options.settings]
    config = load_config(HERE / "study.toml", settings)
    config = without_other_joint(config) if options.alone else config
    kros.run(config, options.out / "all", until=Stage.READ)
    source = next((options.out / "all").glob("*/population.json")).parent
    recordings, table = read(source), dict[str, list[Row]]()
    for held in folds(recordings.unit_ids, options.builds, options.drives):
        changes = {"source": source.absolute(), "reader": "parquet", "prepare": (), "csv": None, "exclude": held}
        folder = options.out / "+".join(held)
        kros.run(
            config.model_copy(update={"data": config.data.model_copy(update=changes)}), folder, until=Stage.SYNTHESIZE
        )
        for name, rows in judged(recordings, held, folder).items():
            table.setdefault(name, []).extend(rows)
    sys.stdout.write(json.dumps(summary(table)) + "\n" if options.json else text(summary(table)))


def without_other_joint(config: StudyConfig) -> StudyConfig:
    """Return the study with the commanded torque as its only input."""
    tables = config.data.model_dump()["csv"]
    tables["channel"] = [c for c in tables["channel"] if not c["name"].startswith("other")]
    for unit in tables["unit"]:
        unit["columns"] = {name: column for name, column in unit["columns"].items() if not name.startswith("other")}
    mapping = CsvMapping.model_validate(tables)
    return config.model_copy(update={"data": config.data.model_copy(update={"csv": mapping})})


def folds(drives: Sequence[str], builds: bool, wanted: Sequence[str] | None) -> list[tuple[str, ...]]:
    """Return the drives of every fold: one, or those of a build."""
    of = {d: d.partition("-")[0] if builds else d for d in drives}
    found = [tuple(d for d in drives if of[d] == name) for name in dict.fromkeys(of.values())]
    return [held for held in found if wanted is None or set(held) & set(wanted)]


def judged(recordings: Population, held: Sequence[str], folder: Path) -> dict[str, list[Row]]:
    """Run everything on the episodes of drives that were left out."""
    others = recordings.select([u for u in recordings.unit_ids if u not in held])
    train = tuple(k for s in split_episodes(others).values() for k in s.train)
    training = TrainingSet(others, train, {u: {} for u in others.unit_ids})
    table: dict[str, list[Row]] = {}
    for drive in held:
        keys = [k for k in recordings.keys(drive) if np.ptp(recordings.read(k)[:, 0]) > STILL_RAD]
        batch = EpisodeBatch.read(recordings, keys)

        def add(name: str, estimate: np.ndarray, *facts: Any, batch: EpisodeBatch = batch, drive: str = drive) -> None:
            percent = error_percent(estimate[..., : batch.states.shape[-1]], batch.states, batch.lengths).mean(axis=0)
            table.setdefault(name, []).append(Row(drive, percent, *facts))

        for name, observer, facts in [*of_study(folder), linear_estimator(training)]:
            own = observer.controller.n_states + observer.lifting.n_states - batch.states.shape[-1]
            run = run_observer(observer, batch.states[..., list(observer.measured)], batch.inputs)
            add(name, run, own, facts["relift_certified"], facts.get("worst_case_h2") is not None)
        for name, make in baselines(training, folder).items():
            baseline = make()
            y = batch.measurements(baseline.measured)
            add(name, baseline.estimate(batch.keys, y, batch.inputs, {}), None, None, None)
    return table


def of_study(folder: Path) -> list[tuple[str, Observer, Mapping[str, Any]]]:
    """Return the observers of a fold's study with what its records say."""
    record = load_artifact(folder / "observers", "observers")[0]
    # One drive alone turns all the way round: its position would be refused as implausible, being beyond 1.5 times what the other drives do.
    loaded = {
        name: replace(Observer.load(folder / "observers" / f"{name}.json"), seen=None) for name in record["names"]
    }
    return [(name, observer, record["facts"][name]) for name, observer in loaded.items()]


def linear_estimator(training: TrainingSet) -> tuple[str, Observer, Mapping[str, Any]]:
    """Return the estimator without lifted functions, which needs no model."""
    population, name = training.population, "linear estimator"
    recordings = Recordings.of(training.keys, training.read_one)
    lifting, dt = Lifting(population.states), population.sample_period_s
    observer = identify_estimator(name, lifting, (0,), population.inputs, recordings, dt).observer
    scales = ReliftScales(recordings.size, recordings.size, recordings.size[:1])
    return name, observer, {"relift_certified": filter_certificate(observer, scales).certified}


def baselines(training: TrainingSet, folder: Path) -> dict[str, Any]:
    """Return what makes the baselines that are no correction of a model."""
    names = [n for n in ("koopman", "koopman_edmd") if (folder / "models" / n).exists()]
    models = ModelSet.load(folder / "models" / names[0])
    nominal = load_artifact(folder / "uncertainty", "choice")[0]["nominal"]
    resolution = load_artifact(folder / "population", "facts")[0]["resolution"]
    noise = np.array([resolution[models.lifting.states[i]] / np.sqrt(12) for i in models.measured])
    return {
        f"{names[0]}/ekf": partial(make_extended, training, models, nominal, noise),
        "filtered_difference": partial(make_difference, training, models.measured),
        "learned": partial(make_learned, training, models.measured),
    }


def summary(table: Mapping[str, Sequence[Row]]) -> dict[str, dict[str, Any]]:
    """Return means over the drives with their interval, and the worst drive, by estimator."""
    found = {}
    for name, rows in table.items():
        percent = np.array([row.percent[1:] for row in rows])
        low, high = unit_interval(percent) if len(rows) > 1 else (percent[0], percent[0])
        states = sorted({row.states for row in rows if row.states is not None})
        errors = {
            channel: {
                "mean": float(percent[:, i].mean()),
                "interval": [float(low[i]), float(high[i])],
                "worst": float(percent[:, i].max()),
            }
            for i, channel in enumerate(SHOWN)
        }
        proofs = {
            key: None if getattr(rows[0], key) is None else sum(getattr(r, key) for r in rows)
            for key in ("running", "robust")
        }
        found[name] = {
            "drives": len(rows),
            "states": states,
            **proofs,
            **errors,
            "to_learned": to_learned(rows, table["learned"]),
        }
    return found


def to_learned(rows: Sequence[Row], learned: Sequence[Row]) -> list[float]:
    """Return the geometric mean over the drives of the velocity error relative to the learned estimator's, drive by drive, and its interval."""
    other = {row.drive: row.percent[1] for row in learned}
    ratios = np.log([row.percent[1] / other[row.drive] for row in rows])
    low, high = unit_interval(ratios) if len(rows) > 1 else (ratios[0], ratios[0])
    return [float(np.exp(value)) for value in (ratios.mean(), low, high)]


def text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table."""
    lines = [
        f"{'observer':44s} {'states':>7s} {'as it runs':>10s} {'in the set':>10s} {'velocity':>30s} {'to learned':>20s} {'torque':>30s}"
    ]
    for name, row in found.items():
        proofs = ["-" if row[key] is None else f"{row[key]}/{row['drives']}" for key in ("running", "robust")]
        cells = [
            f"{e['mean']:8.3g} {'({:.3g}, {:.3g})'.format(*e['interval']):>13s} {e['worst']:7.3g}"
            for e in (row[c] for c in SHOWN)
        ]
        ratio = "{:.3g} ({:.3g}, {:.3g})".format(*row["to_learned"])
        states = "-" if not row["states"] else "/".join(map(str, row["states"]))
        lines.append(
            f"{name:44s} {states:>7s} {proofs[0]:>10s} {proofs[1]:>10s} {cells[0]:>30s} {ratio:>20s} {cells[1]:>30s}"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
