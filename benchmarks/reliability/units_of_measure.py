"""The same recordings in other units of measure: drives, pendulums and DC motors, channels multiplied by 1e-9 and 1e9, one at a time and mixed.

Every study is compared with that of the recordings as simulated: all errors in percent, free-run errors, outlier scores, hidden errors, and the estimates
of the observer that is handed over, scaled back. Formulas, ratios and declared noise are scaled as the recordings are. Mixtures are tried with refined
models and worst-case synthesis, single channels with EDMD models, which take a tenth of the time.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Tally, main

import kros
from kros.data import EpisodeBatch, Population, write_parquet
from kros.identify import PhaseCalibration
from kros.observer import Observer
from kros.plants import PLANTS
from kros.study.config import Stage, validate_config

LARGEST = 0.01  # relative deviation that is a failure
NOISE = {"harmonic-drive": 2e-5, "pendulum": 4e-4, "dc-motor": 4e-4}  # of the position, rad
SETTINGS: dict[str, dict[str, Any]] = {
    "harmonic-drive": {"n_units": 3, "n_episodes": 3, "seconds": 6.0},
    "pendulum": {"n_units": 3, "n_episodes": 3, "seconds": 4.0},
    "dc-motor": {"n_units": 3, "n_episodes": 3, "seconds": 1.4},
}
FUNCTIONS = {
    "harmonic-drive": "sin(100*{position} + phase)",
    "pendulum": "sin({position})",
    "dc-motor": "tanh({velocity})",
}
RATIO = 100.0
Factors = Mapping[str, float]


@dataclass(frozen=True)
class Multiplied:
    """A source whose channels are multiplied, as another acquisition would have written them."""

    source: Any
    factors: Any

    def __call__(self, key: Any) -> Any:
        """Return the samples of an episode."""
        return self.source(key)[:, : len(self.factors)] * self.factors


@dataclass(frozen=True)
class Found:
    """What a study says, by name, and what its deployed observer estimates in the units of the simulation."""

    numbers: dict[str, float]
    deployed: str
    estimates: Any


def simulated(plant: str, seed: int) -> Population:
    """Return the population as simulated, without what is known about its plant."""
    population = PLANTS[plant](**SETTINGS[plant], seed=seed).simulate().population
    return replace(population, metadata={})


def in_units(population: Population, factors: Factors) -> Population:
    """Return the recordings with channels multiplied, without the true signals."""
    return replace(
        population,
        source=Multiplied(population.source, np.array([factors.get(c.name, 1.0) for c in population.channels])),
        columns=population.channels,
    )


def study(plant: str, population: Population, factors: Factors, folder: Path, *, refine: bool) -> Found:
    """Make a small study of recordings in other units, formulas and declared noise with them."""
    write_parquet(in_units(population, factors), folder / "recordings")
    names = {
        c.name: f"({1 / factors[c.name]!r}*{c.name})" if c.name in factors else c.name for c in population.channels
    }
    raw: dict[str, Any] = {
        "data": {"source": str(folder / "recordings"), "reader": "parquet"},
        "lifting": {"functions": [FUNCTIONS[plant].format(**names)]},
        "identify": {"refine": refine},
        "uncertainty": {"n_freqs": 60},
        "synthesis": {
            "methods": ["worst_case_h2", "residual_h2", "estimator"] if refine else ["residual_h2", "estimator"],
        },
        "sensor": {"position": {"noise": NOISE[plant] * factors.get("position", 1.0)}},
    }
    if plant == "harmonic-drive":
        raw["calibrate"] = {"ratio": RATIO / factors.get("position", 1.0)}
    metrics = kros.run(validate_config(raw, folder), folder / "run", until=Stage.EVALUATE, workers=1).metrics
    deployed = Observer.load(folder / "run" / "observers" / "deployed.json")
    return Found(
        numbers_of(metrics), metrics["study"]["deployed"], estimates(deployed, population, factors, folder / "run")
    )


def numbers_of(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return every error in percent and every score, by what it is of."""
    found = {}
    for row in metrics["evaluation"]:
        found["/".join(("error", *(row[k] for k in ("observer", "unit", "condition", "channel"))))] = row[
            "error_percent"
        ]
    for name, model in metrics["models"].items():
        for channel, errors in model["freerun_error_percent"].items():
            found |= {f"free run/{name}/{channel}/{which}": value for which, value in errors.items()}
    for row in metrics["outliers"]:
        found[f"score/{row['unit']}/{row['condition']}"] = row["score"]
    for name, facts in metrics["observers"].items():
        if facts.get("hidden_error_percent") is not None:
            found[f"hidden/{name}"] = facts["hidden_error_percent"]
    return found


def estimates(observer: Observer, population: Population, factors: Factors, run: Path) -> Any:
    """Run the observer that is handed over on the last episode of every unit; return estimates in the units of the simulation."""
    condition = "noload" if "noload" in population.conditions else population.conditions[0]
    keys = [population.keys(unit, condition)[-1] for unit in population.unit_ids]
    batch = EpisodeBatch.read(in_units(population, factors), keys)
    values: dict[str, Any] = {}
    if observer.lifting.parameters:
        phases = PhaseCalibration.load(run / "calibration").units
        values = {"phase": np.array([phases[k.unit].phase_rad for k in keys])}
    found = observer.run(batch.states[..., list(observer.measured)], batch.inputs, values)[
        ..., : len(population.states)
    ]
    return found / np.array([factors.get(name, 1.0) for name in population.states])


def deviation(one: Found, other: Found) -> tuple[float, str]:
    """Return the largest relative deviation and what it is of; infinite where one study has what the other has not.

    Scores are levels: their deviation is that of the ratio that they stand for.
    """
    if set(one.numbers) != set(other.numbers) or one.deployed != other.deployed:
        missing = sorted(set(one.numbers) ^ set(other.numbers)) or [one.deployed, other.deployed]
        return np.inf, ", ".join(missing[:3])
    worst, where = 0.0, ""
    for name, value in one.numbers.items():
        far = abs(other.numbers[name] - value)
        far = 10 ** (far / 20) - 1 if name.startswith("score") else far / max(abs(value), 1e-300)
        if not far <= worst:
            worst, where = far, name
    size = np.abs(one.estimates).max(axis=(0, 1))
    far = float((np.abs(other.estimates - one.estimates).max(axis=(0, 1)) / size).max())
    return (far, "estimates") if not far <= worst else (worst, where)


def scalings(population: Population, rng: np.random.Generator) -> Iterator[Factors]:
    """Every channel by itself, smaller and larger, then two mixtures."""
    names = [c.name for c in population.channels]
    for name in names:
        for factor in (1e-9, 1e9):
            yield {name: factor}
    for _ in range(2):
        yield dict(zip(names, rng.choice([1e-9, 1e9], len(names)).tolist(), strict=True))


def fresh(plant: str, population: Population, factors: Factors, *, refine: bool) -> Found:
    """Make a study in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        return study(plant, population, factors, Path(folder), refine=refine)


def run(count: int, seed: int) -> list[Tally]:
    """Compare the studies of at most `count` scalings of every plant and kind with the study of the recordings as simulated."""
    rng, tallies = np.random.default_rng(seed), []
    for plant in SETTINGS:
        population = simulated(plant, seed + 1)
        every = list(scalings(population, rng))
        for kind, chosen in (
            ("EDMD models, one channel", [f for f in every if len(f) == 1]),
            ("refined models, mixed", [f for f in every if len(f) > 1]),
        ):
            refine = kind.startswith("refined")
            tally = Tally(
                f"units of measure, {plant}, {kind}", "the same recordings in the units of the simulation, within 1 %"
            )
            largest, place, first = 0.0, "none", fresh(plant, population, {}, refine=refine)
            for factors in chosen[:count]:
                far, where = deviation(first, fresh(plant, population, factors, refine=refine))
                tally.add("within 1 %" if far <= LARGEST else f"off: {where}", failed=not far <= LARGEST)
                if not far <= largest:
                    largest, place = far, where
            tally.note = f"{len(first.numbers)} numbers each; largest relative deviation {largest:.1e}, of {place}"
            tallies.append(tally)
    return tallies


if __name__ == "__main__":
    main("units_of_measure", "The same recordings in other units of measure", run, 100)
