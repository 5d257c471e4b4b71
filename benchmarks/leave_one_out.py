"""Observers on units that took no part in identification, synthesis, tuning or training, over simulated populations.

    python benchmarks/leave_one_out.py --loop stiff soft --spread 1 3 --units 12 --folds 4

Units are split into folds. For every fold the nominal model is the mean of the refined models of all other units, with their
training episodes observers are made, tuned and trained, and the fold's own units judge them on their test episodes; a unit's phase comes
from its own training episodes, as it would on a new machine. Prints a line for every observer and condition: mean over the units with the
95 % interval of a bootstrap over units, and the worst unit, of velocity and current in percent of the range; with the states of its filter,
or its memory, and in how many folds its deployed form is certified.
Nothing is shared between folds: refinement centres every unit on a pooled model, so that even a unit's own model knows the others.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from kros.data import Population, read_parquet, split_episodes
from kros.data.population import EpisodeKey
from kros.evaluate import EpisodeBatch, error_percent, unit_interval
from kros.identify import PhaseSpec
from kros.identify.phase import resolve_branches, unit_phase
from kros.identify.refine import refine_population
from kros.lifting import Lifting
from kros.observer import (
    Features,
    FilteredDifference,
    Moments,
    Observer,
    Past,
    cutoffs_hz,
    kalman_candidates,
    luenberger_candidates,
    relift_certificate,
    remembering_observer,
    residual_models,
    tune_observer,
)
from kros.study.demo import simulate_to
from kros.study.stages.calibrate import segments_of
from kros.study.tuning import Judge, rank
from kros.synthesis import Injection, Synthesis, residual_h2

HOME, STATES, HIDDEN = "noload", ("position", "velocity", "current"), (1, 2)
LIFTING = Lifting(STATES, ("sin(100*position + phase)",), ("phase",))
CIRCLE = Lifting(STATES, ("sin(100*position + phase)", "cos(100*position + phase)"), ("phase",))
MEASURED, INPUTS = (0,), ("target_position", "target_velocity")
TRAIN_EPISODES, TRAIN_SAMPLES, TUNE_SAMPLES = 3, 10_000, 8_000
MEMORY_EPISODES, MEMORY_SAMPLES, STEPS = 2, 6_000, 8
IMPORTANCE = (4.0, 1.0)  # of velocity and current: unless it is asked for, tuning trades a percent of velocity for ten of current


@dataclass(frozen=True)
class Recordings:
    """A population, its split and its units' phases."""

    population: Population
    train: dict[tuple[str, str], tuple[EpisodeKey, ...]]
    test: dict[tuple[str, str], tuple[EpisodeKey, ...]]
    parameters: dict[str, dict[str, float]]
    resolution: float

    @classmethod
    def read(cls, folder: Path, resolution: float) -> Recordings:
        """Read a folder and calibrate every unit."""
        population = read_parquet(folder)
        split = split_episodes(population)
        spec = PhaseSpec(ratio=100.0)
        units = {u: unit_phase(segments_of((population, split[u, HOME].train, spec)), u) for u in population.unit_ids}
        phases = resolve_branches(units, list(units), spec).units
        return cls(
            population,
            {key: s.train for key, s in split.items()},
            {key: s.test for key, s in split.items()},
            {u: {"phase": p.phase_rad} for u, p in phases.items()},
            resolution,
        )

    def judge(
        self, part: dict[tuple[str, str], tuple[EpisodeKey, ...]], units: list[str], condition: str, most: int | None = None
    ) -> Judge:
        """Read episodes of some units; at most so many samples of the first few where `most` is given."""
        keys = [k for u in units for k in part[u, condition][: TRAIN_EPISODES if most else None]]
        batch = EpisodeBatch.read(self.population, keys, most)
        return Judge(batch, batch.parameters(self.parameters))


def main() -> None:
    """Run all populations and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loop", choices=["stiff", "soft"], nargs="+", default=["stiff", "soft"])
    parser.add_argument("--spread", type=float, nargs="+", default=[1.0, 3.0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--units", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--folds", type=int, default=4)
    options = parser.parse_args()
    for loop, spread in product(options.loop, options.spread):
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "recordings"
            simulate_to(out, "harmonic-drive", options.units, options.episodes, 20.0, options.seed, spread, loop, False, "parquet")
            began = time.perf_counter()
            errors, facts = leave_out(Recordings.read(out, quantum(out)), options.folds)
            say(
                f"\n{loop} loop, spread {spread:g}, seed {options.seed}, {options.units} units in {options.folds} folds "
                f"({time.perf_counter() - began:.0f} s)"
            )
            show(errors, facts)


def quantum(folder: Path) -> float:
    """Smallest step of the measured position."""
    population = read_parquet(folder)
    steps = np.abs(np.diff(population.read(population.episodes[0])[:, 0]))
    return float(steps[steps > 0].min())


def leave_out(data: Recordings, folds: int) -> tuple[dict[tuple[str, str], np.ndarray], dict[str, tuple[str, str]]]:
    """Return errors (unit, hidden state) by observer and condition, and by observer its orders and the folds in which it is certified."""
    ids = list(data.population.unit_ids)
    errors: dict[tuple[str, str], list[np.ndarray]] = {}
    orders: dict[str, set[int | str]] = {}
    certified: dict[str, list[bool]] = {}
    for fold in range(folds):
        held = ids[fold::folds]
        estimators = estimators_without(data, [u for u in ids if u not in held])
        for name, estimator in estimators.items():
            orders.setdefault(name, set()).add(memory_of(estimator))
            if isinstance(estimator, Observer):
                certified.setdefault(name, []).append(relift_certificate(estimator, mismatch=False).certified)
        for condition in sorted({c for _, c in data.test}):
            judge = data.judge(data.test, held, condition)
            y, truth = judge.measurements(MEASURED), judge.batch.states
            for name, estimator in estimators.items():
                estimate = estimator.run(y, judge.batch.inputs, judge.parameters)[..., : len(STATES)]
                percent = error_percent(estimate, truth, judge.batch.lengths)[:, list(HIDDEN)]
                own = [percent[[i for i, k in enumerate(judge.batch.keys) if k.unit == u]].mean(axis=0) for u in held]
                errors.setdefault((name, condition), []).extend(own)
    proofs = {name: f"{sum(certified[name])}/{folds}" if name in certified else "-" for name in orders}
    return {k: np.array(v) for k, v in errors.items()}, {k: ("/".join(map(str, sorted(v, key=str))), proofs[k]) for k, v in orders.items()}


def memory_of(estimator: object) -> int | str:
    """States besides the recorded ones."""
    if not isinstance(estimator, Observer):
        return "-"
    return estimator.controller.n_states + estimator.lifting.n_states - len(STATES)


def estimators_without(data: Recordings, units: list[str]) -> dict[str, object]:
    """Make all observers and estimators from the training episodes of some units."""
    population = data.population.select(units)
    keys = {u: data.train[u, HOME] for u in units}
    phases = {"phase": np.array([data.parameters[u]["phase"] for u in units])}
    models = refine_population(population, keys, LIFTING, phases, stacked(population, keys, phases)).units
    A, B = models.A.mean(axis=0), models.B.mean(axis=0)
    judge = data.judge(data.train, units, HOME, TRAIN_SAMPLES)
    batch, dt = judge.batch, population.sample_period_s
    scale, noise = np.abs(batch.states).max(axis=(0, 1)), np.array([data.resolution / np.sqrt(12)])
    plain = Observer.open_loop("open loop", LIFTING, A, B, MEASURED, INPUTS, dt)
    found: dict[str, object] = {"open_loop": plain}
    found |= tuned_gains(judge, plain, np.concatenate([scale, [1.0]]), noise)
    owners = [k.unit for k in batch.keys]
    designs = residual_models(
        LIFTING, A, B, MEASURED, batch.states, batch.inputs, batch.lengths, owners, judge.parameters, noise, scale, dt
    )
    identified = next(d for d in designs if not d.refitted)

    def observer(design, order: int) -> Observer:  # type: ignore[no-untyped-def]
        synthesis = residual_h2(
            design.dynamics, np.eye(3)[[0]], design.spectra, noise, scale, dt, n_lifted=LIFTING.n_lifted, max_order=order
        )
        return replace(plain, A=design.A, B=design.B, controller=synthesis.controller)

    found["residual_h2, model as identified"] = observer(identified, 12)
    for order in (12, 6):
        found[f"residual_h2, {order} states"] = observer(designs[0], order)
    start = observer(designs[0], 2)
    short = judge.first(TUNE_SAMPLES)
    delays = 6 - start.controller.n_states
    found["residual_h2, tuned, 6 states"] = tune_observer(
        start, short.batch.states, short.batch.inputs, short.parameters, delays=delays
    ).observer
    found["filtered_difference"] = difference(judge, dt)
    recordings = (batch.states, batch.inputs, batch.lengths, owners, judge.parameters)
    past = Past.of(CIRCLE, MEASURED, *recordings)
    for order in (12, 6):
        start, tuned = remembering(past, order, short, owners, dt)
        found[f"with memory, {order} states"], found[f"with memory, tuned, {order} states"] = start, tuned
    found["learned"] = Moments.of(Features.of(LIFTING, MEASURED, batch.states[..., :1], batch.inputs), *recordings).estimator()
    return found


def remembering(past: Past, memories: int, judge: Judge, owners: list[str], dt: float) -> tuple[Observer, Observer]:
    """The observer with memory, and what tuning on the first two episodes of every unit makes of it."""
    x, u, values = judge.batch.states[:MEMORY_SAMPLES], judge.batch.inputs[:MEMORY_SAMPLES], judge.parameters
    start = remembering_observer("memory", past, memories, INPUTS, x, u, dt, values, importance=IMPORTANCE)
    few = [i for i in range(len(owners)) if owners[:i].count(owners[i]) < MEMORY_EPISODES]
    own = {name: value[few] for name, value in values.items()}
    return start, tune_observer(start, x[:, few], u[:, few], own, iterations=STEPS, importance=IMPORTANCE).observer


def stacked(population: Population, keys: dict[str, tuple[EpisodeKey, ...]], phases: dict[str, np.ndarray]):  # type: ignore[no-untyped-def]
    """Factors of all units for the lifting."""
    from kros.identify import Factor, combine, lifted_factor, reduce_episode

    own = [combine(Factor.stack([reduce_episode(*population.read_parts(k), LIFTING) for k in keys[u]])) for u in keys]
    return lifted_factor(Factor.stack(own), LIFTING, phases, LIFTING)


def tuned_gains(judge: Judge, plain: Observer, scale: np.ndarray, noise: np.ndarray) -> dict[str, object]:
    """Kalman filter and Luenberger observer with the gains that do best on training episodes."""
    C, n = np.eye(LIFTING.n_lifted)[[0]], LIFTING.n_states
    kalmans = [s for _, s in kalman_candidates(plain.A, C, scale, np.diag(noise**2), plain.sample_period_s)]
    placed = [lifted(s) for _, s in luenberger_candidates(plain.A[:n, :n], C[:, :n], plain.sample_period_s)]
    found: dict[str, object] = {}
    for name, tried in (("kalman_tuned", kalmans), ("luenberger", placed)):
        candidates = [replace(plain, controller=s.controller, injection=Injection.STATE) for s in tried]
        percents = judge.percent_of_all([plain, *candidates])
        ranks = [rank(p, percents[0], MEASURED) for p in percents[1:]]
        found[name] = candidates[min(range(len(ranks)), key=lambda i: ranks[i])]
    return found


def lifted(synthesis: Synthesis) -> Synthesis:
    """Add a row of zeros for the lifted function."""
    K = synthesis.controller
    return replace(synthesis, controller=replace(K, C=np.zeros((LIFTING.n_lifted, 0)), D=np.vstack([K.D, [[0.0]]])))


def difference(judge: Judge, dt: float) -> FilteredDifference:
    """The best cut-off on training episodes."""
    y, b = judge.measurements(MEASURED), judge.batch
    tried = [FilteredDifference(3, ((0, 1),), float(f), dt) for f in cutoffs_hz(dt)]
    return min(tried, key=lambda d: float(error_percent(d.run(y, b.inputs)[..., 1:2], b.states[..., 1:2], b.lengths).mean()))


def show(errors: dict[tuple[str, str], np.ndarray], facts: dict[str, tuple[str, str]]) -> None:
    """Print the table."""
    columns = f"{'mean':>8s} {'(95 %)':>18s} {'worst':>8s}"
    say(f"{'percent of range':36s} {'':>7s} {'':>9s} {'':9s} {'velocity':>17s} {'current':>37s}")
    say(f"{'observer':36s} {'states':>7s} {'certified':>9s} {'condition':9s} {columns} {columns}")
    for (name, condition), values in sorted(errors.items(), key=lambda row: row[0][1] != HOME):
        low, high = unit_interval(values)
        mean, worst = values.mean(axis=0), values.max(axis=0)
        cells = [f"{m:8.4f} {f'({a:.4f}, {b:.4f})':>18s} {w:8.4f}" for m, a, b, w in zip(mean, low, high, worst, strict=True)]
        say(f"{name:36s} {facts[name][0]:>7s} {facts[name][1]:>9s} {condition:9s} {' '.join(cells)}")


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
