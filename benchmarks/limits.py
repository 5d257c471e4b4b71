"""Predictors at the current's limit: simulated drives of spread 3 under load, left out in three folds, against the learned estimator.

    python benchmarks/limits.py --loop stiff --seeds 404 402

Predictors are identified from unloaded episodes, or from those of both conditions, of the other units, whose recordings the limit is found in too.
Per unit at its limit: share of samples, and error in percent of the largest value.
"""

import argparse
from dataclasses import replace

import numpy as np

from kros.data import EpisodeBatch
from kros.data.survey import survey
from kros.lifting import Lifting
from kros.observer import identify_predictor, relift_certificate, run_observer
from kros.observer.baselines.learned import Features
from kros.observer.baselines.learned_moments import Moments
from kros.observer.predictor.driven import driven_coordinates
from kros.observer.predictor.limited import conditioned, with_limits
from kros.plants.harmonic_drive.population import HarmonicDrivePopulation

FOLDS, HELD = 3, "3"


def percent(estimate: np.ndarray, batch: EpisodeBatch) -> np.ndarray:
    """Return errors of velocity and current in percent of the largest value, shape (batch, 2)."""
    x = batch.states[..., 1:3]
    return 100 * np.sqrt(np.mean((estimate[..., 1:3] - x) ** 2, axis=0)) / np.abs(x).max(axis=0)


def fold(population, parameters, test: list[str], conditions: tuple[str, ...]) -> None:
    """Identify on all other units, run on the held-out loaded episode of some."""
    train = [u for u in population.unit_ids if u not in test]
    keys = [k for k in population.episodes if k.unit in train and k.episode != HELD]
    limit = survey(population.select(train))[1].limits.get("current")
    if limit is None:
        print("no limit was found on", train)
        return
    learn = EpisodeBatch.read(population, [k for k in keys if k.condition in conditions], None, parameters)
    scale, inputs = np.abs(learn.states).max(axis=(0, 1)), np.abs(learn.inputs).max(axis=(0, 1))

    def normal(batch: EpisodeBatch) -> EpisodeBatch:
        return replace(batch, states=batch.states / scale, inputs=batch.inputs / inputs)

    lifting = Lifting(population.states, ("sin(100*position + phase)", "cos(100*position + phase)"), ("phase",))
    sizes = dict(zip(population.states + population.inputs, [*scale, *inputs], strict=True))
    before = identify_predictor(
        "before", lifting.in_sizes(sizes), (0,), population.inputs, normal(learn), iterations=4, episodes=1
    )
    inf = np.array([np.inf, np.inf])
    lower, upper = (
        np.append(side * inf, side * np.inf if v is None else v) for side, v in ((-1, limit.lower), (1, limit.upper))
    )
    loaded = EpisodeBatch.read(population, [k for k in keys if k.condition == "load"], 6000, parameters)
    met = np.mean(np.abs(loaded.states[..., 2]) > 0.99, axis=0)
    at = normal(loaded.take([int(i) for i in np.argsort(-met)[:12] if met[i] > 0]))
    limited = with_limits(before, lower / scale, upper / scale)
    now = driven_coordinates(conditioned(limited, at), at, np.ones(3))
    features = Features.of(lifting, (0,), learn.states[..., :1], learn.inputs)
    moments = Moments.of(features, [learn], 0.1 * scale)
    learned = moments.estimator((), moments.choose())
    held = EpisodeBatch.read(
        population, [k for k in population.episodes if k.unit in test and k.episode == HELD], None, parameters
    )
    y, found = held.states[..., :1], {}
    found["learned"] = learned.run(y, held.inputs, held.parameters)
    found["told"] = np.clip(found["learned"], lower, upper)
    for name, observer in (("before", before), ("now", now)):
        found[name] = run_observer(observer, y / scale[0], held.inputs / inputs, held.parameters)[..., :3] * scale
    errors = {name: percent(estimate, held) for name, estimate in found.items()}
    print(
        "certified" if relift_certificate(now, mismatch=False).certified else "not certified, a study halves the gain"
    )
    for row, key in enumerate(held.keys):
        share = 100 * np.mean(np.abs(held.states[:, row, 2]) > 0.99)
        same = np.allclose(errors["before"][row], errors["now"][row], rtol=1e-6)
        if share > 0.2 or not same:
            shown = ", ".join(f"{name} {e[row, 0]:.4f} / {e[row, 1]:.1f}" for name, e in errors.items())
            print(f"{key.unit} {key.condition}: {share:.1f} % at the limit; velocity / current: {shown}", flush=True)


def main() -> None:
    """Run all populations that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loop", default="stiff", choices=("stiff", "soft"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[404])
    parser.add_argument("--units", type=int, default=12)
    options = parser.parse_args()
    for seed in options.seeds:
        made = HarmonicDrivePopulation(
            n_units=options.units, n_episodes=4, seconds=8.0, seed=seed, spread=3.0, loop=options.loop
        ).simulate()
        phases = zip(made.truth.unit_ids, made.truth.phase_rad, strict=True)
        parameters = {unit: {"phase": float(phase)} for unit, phase in phases}
        for conditions in (("noload",), ("noload", "load")):
            print(f"{options.loop}, seed {seed}, identified on {' and '.join(conditions)}")
            for part in range(FOLDS):
                fold(made.population, parameters, list(made.population.unit_ids[part::FOLDS]), conditions)


if __name__ == "__main__":
    main()
