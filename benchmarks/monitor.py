"""The monitor on simulated drives: healthy ones, badly assembled ones, more friction, a rougher gearbox.

    python benchmarks/monitor.py --loop stiff --seeds 40 --work monitor-work

One observer is designed for a loop, on a population of 12 drives of its own (seed 9041): identified, quantified, `--method` synthesised, kept in `--work`.
Then every seed is a population of the same distribution: 12 drives, 6 episodes of 12 s with and without load each, that the monitor's bounds are found
on by `fit_monitor`, as a study does; 12 further good drives, 2 episodes of 14 s each, which count false alarms; and one faulty drive of every kind and
severity, which has ten seconds of motion in each condition to be found. New drives follow other trajectories than those of training. Faults are those of
the simulator: its badly assembled drive (`outlier_severity`; 1 is its default), all friction times a factor, all harmonics of the gearbox times a factor.
Phases are the simulation's.

Printed are counts over all seeds; rates of false alarms with exact 95 % intervals (binomial a unit, Poisson an hour of motion).
`--own` judges further good drives against the monitor found on the very drives that the observer was designed on.
"""

import argparse
import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import beta, chi2

import kros
from kros.data import EpisodeBatch, Unit
from kros.design.monitor import MonitorSettings, fit_monitor
from kros.design.training import TrainingSet
from kros.identify.identified import IdentifiedModels
from kros.observer import Observer
from kros.observer.monitor import Watch
from kros.observer.simulate import run_innovations
from kros.plants.harmonic_drive.dynamics import DriveParameters
from kros.plants.harmonic_drive.population import HarmonicDrivePopulation

DESIGN_SEED, UNITS, EPISODES, SECONDS, WITHIN_S, RATE = 9041, 12, 6, 12.0, 10.0, 0.02
NEW_EPISODES, NEW_SECONDS = 2, 14.0
ELSEWHERE = 1_000_000  # seed of the motions of new drives beside that of training
CONDITIONS = ("load", "noload")
FRICTION = ("coulomb_torque", "breakaway_torque", "viscous_friction")
FAULTS = {
    "badly assembled": (0.25, 0.5, 0.75, 1.0, 1.25, 1.5),
    "friction": (1.25, 1.5, 2.0, 3.0, 5.0),
    "gearbox oscillation": (1.25, 1.5, 2.0, 3.0),
}


@dataclass(frozen=True)
class Given(HarmonicDrivePopulation):
    """A batch of drives that are given."""

    drives: DriveParameters | None = None

    def units(self):
        return tuple(Unit(f"{k:06d}", "population") for k in range(len(self.drives))), vars(self.drives)


def drawn(seed: int, n_units: int, **outlier: float) -> DriveParameters:
    """Return the drives of a batch."""
    return DriveParameters(**HarmonicDrivePopulation(n_units=n_units, seed=seed, **outlier).units()[1])


def faulty(seed: int, kind: str, severity: float) -> DriveParameters:
    """Return one faulty drive."""
    if kind == "badly assembled":
        return drawn(seed, 1, outlier=True, outlier_severity=severity).take([0])
    good = drawn(seed, 1, outlier=True, outlier_severity=0.0).take([0])
    names = FRICTION if kind == "friction" else ("ripple",)
    return replace(good, **{name: getattr(good, name) * severity for name in names})


def designed(loop: str, method: str, work: Path) -> tuple[Observer, TrainingSet]:
    """Return the observer of a loop and the episodes that it was designed on; made once."""
    folder = work / f"{loop}-{method.replace('/', '-')}"
    if not (folder / "observer.json").exists():
        population = (
            HarmonicDrivePopulation(n_units=UNITS, n_episodes=6, seconds=12.0, seed=DESIGN_SEED, loop=loop)
            .simulate()
            .population
        )
        models = kros.identify(population, lifting=["sin(100*position + phase)"])
        models.save(folder / "models")
        kros.synthesize(kros.quantify(models), method).observer.save(folder / "observer.json")
    models = IdentifiedModels.load(folder / "models")
    return Observer.load(folder / "observer.json"), TrainingSet.whole(models, models.models(method.split("/")[0]))


def record(drives: DriveParameters, seed: int, loop: str, episodes: int, seconds: float = SECONDS) -> TrainingSet:
    """Simulate and return all episodes."""
    simulated = Given(
        n_units=len(drives), n_episodes=episodes, seconds=seconds, seed=seed, loop=loop, drives=drives
    ).simulate()
    population, truth = simulated.population, simulated.truth
    phases = {unit: {"phase": float(phase)} for unit, phase in zip(truth.unit_ids, truth.phase_rad, strict=True)}
    return TrainingSet(population, population.episodes, phases)


def levels(observer: Observer, recorded: TrainingSet) -> list[tuple[str, str, np.ndarray, np.ndarray]]:
    """Return unit, condition, level over the bound and motion so far in seconds, of every episode."""
    monitor, rows, dt = observer.monitor, [], observer.sample_period_s
    for start in range(0, len(recorded.keys), 60):
        batch = EpisodeBatch.read(recorded.population, recorded.keys[start : start + 60], None, recorded.parameters)
        y = batch.measurements(observer.measured)
        nu, judged = run_innovations(observer, y, batch.inputs, observer.own(batch.parameters), monitor.settle)
        step = np.abs(np.diff(y, axis=0, prepend=y[:1]))[..., 0]
        motion = np.cumsum(step > 0.1 * np.sqrt(np.mean(step**2)), axis=0) * dt
        for i, key in enumerate(batch.keys):
            level = monitor.level(Watch(monitor).mean_squares(nu[:, i], judged[:, i]))
            rows.append((key.unit, key.condition, level, motion[:, i]))
    return rows


class Count:
    """Alarms among good drives, of units and in hours of motion."""

    def __init__(self) -> None:
        self.units = self.alarmed = self.alarms = 0
        self.hours = 0.0

    def add(self, rows: list) -> None:
        """Take the episodes of good drives."""
        wrong: dict[str, bool] = {}
        for unit, _, level, motion in rows:
            outside = level > 0
            wrong[unit] = wrong.get(unit, False) or bool(outside.any())
            self.alarms += int(np.count_nonzero(np.diff(outside.astype(int), prepend=0) == 1))
            self.hours += motion[-1] / 3600
        self.units, self.alarmed = self.units + len(wrong), self.alarmed + sum(wrong.values())

    def __str__(self) -> str:
        n, k = self.units, self.alarmed
        low, high = (beta.ppf(0.025, k, n - k + 1) if k else 0.0), (beta.ppf(0.975, k + 1, n - k) if k < n else 1.0)
        interval = [chi2.ppf(p, 2 * n) / 2 for p, n in ((0.025, self.alarms), (0.975, self.alarms + 1))]  # Garwood
        per_hour = [x / self.hours for x in (self.alarms, *np.nan_to_num(interval))]
        share = f"{k} of {n} units, {100 * k / n:.2f} % (95 %: {100 * low:.2f} to {100 * high:.2f})"
        return f"{share}; {self.alarms} in {self.hours:.2f} h of motion, {per_hour[0]:.2f} an hour (95 %: {per_hour[1]:.2f} to {per_hour[2]:.2f})"


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loop", default="stiff", choices=("stiff", "soft"))
    parser.add_argument("--method", default="koopman/estimator")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--rate", type=float, default=RATE)
    parser.add_argument("--units", type=int, default=UNITS)
    parser.add_argument(
        "--own", type=int, default=0, help="further good drives against the monitor of the observer's own drives"
    )
    parser.add_argument("--work", type=Path, required=True)
    args = parser.parse_args()
    logging.disable(logging.INFO)
    observer, training = designed(args.loop, args.method, args.work)
    if args.own:
        own = replace(observer, monitor=fit_monitor(observer, training, MonitorSettings(args.rate)))
        print(json.dumps({"units": own.monitor.units, "settle_samples": own.monitor.settle}), flush=True)
        count = Count()
        for start in range(0, args.own, 20):
            drives = drawn(DESIGN_SEED, UNITS + start + 20).take(slice(UNITS + start, None))
            count.add(levels(own, record(drives, args.first + start, args.loop, NEW_EPISODES, NEW_SECONDS)))
        print(f"{args.loop} own drives: {count}", flush=True)
        return
    count = Count()
    found: dict[tuple, list[bool]] = {}
    for seed in range(args.first, args.first + args.seeds):
        good = drawn(seed, args.units + UNITS)
        kinds = [(kind, s) for kind, severities in FAULTS.items() for s in severities]
        watched = replace(
            observer,
            monitor=fit_monitor(
                observer, record(good.take(slice(args.units)), seed, args.loop, EPISODES), MonitorSettings(args.rate)
            ),
        )
        others = record(good.take(slice(args.units, None)), ELSEWHERE + seed, args.loop, NEW_EPISODES, NEW_SECONDS)
        count.add(levels(watched, others))
        drives = faulty(seed, *kinds[0])
        for kind in kinds[1:]:
            drives = DriveParameters(
                *(
                    np.concatenate(pair)
                    for pair in zip(vars(drives).values(), vars(faulty(seed, *kind)).values(), strict=True)
                )
            )
        for unit, condition, level, motion in levels(
            watched, record(drives, ELSEWHERE + seed, args.loop, 1, NEW_SECONDS)
        ):
            within = level[motion <= WITHIN_S].max()
            found.setdefault((*kinds[int(unit)], condition), []).append(within > 0)
        if (seed - args.first + 1) % 10 == 0:
            show(args, seed - args.first + 1, count, found)


def show(args: argparse.Namespace, done: int, count: Count, found: dict[tuple, list[bool]]) -> None:
    """Print what was found so far."""
    print(f"{args.loop} {args.method} {args.units} drives, rate {args.rate}, good drives: {count}")
    print(f"found within {WITHIN_S:g} s of motion, of {done}")
    for kind, severities in FAULTS.items():
        for s in severities:
            texts = [f"{c} {sum(found[kind, s, c])}" for c in CONDITIONS]
            print(f"  {kind} {s:g}: " + ", ".join(texts), flush=True)


if __name__ == "__main__":
    main()
