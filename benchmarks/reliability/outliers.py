"""Outlier scores on populations whose truth is known: how often good units are flagged that were recorded less, and whether bad ones are found.

    python benchmarks/reliability/outliers.py --count 100

Every population is 12 drives (two states, one input) with log-normal parameters, driven by noise of their own in episodes of 300 samples, identified by
regularised least squares as a study does it. Good units of the same distribution and badly assembled ones (half the torque, four times the
friction) are recorded as much, 6/10 as much, in one episode, and in short episodes, and scored. What is good and what is bad is known from the simulation.

The rate is stated for every good unit. Counts are held against the largest count that it makes likely (0.1 % of such campaigns would have more).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt
from campaign import Tally, main
from scipy.linalg import expm
from scipy.stats import binom

from kros.data import Channel, Role
from kros.identify import Factor, ModelSet
from kros.identify.factors import reduce_episode
from kros.lifting import Lifting
from kros.uncertainty import OutlierModel, score_outliers
from kros.uncertainty.outliers.population import Evidence, Recorded
from kros.uncertainty.outliers.score import Status

Array = npt.NDArray[Any]

PERIOD_S, SAMPLES, EPISODES, UNITS = 0.01, 300, 10, 12
LIFTING = Lifting(("position", "velocity"))
FREQS = np.geomspace(0.05, 45.0, 60)
RATE = 1e-2
NEW = 3  # good units of every kind that one population is asked about
CONFIDENCE = 0.999
AMOUNTS = {  # episodes and samples of each
    "as much as the others": (EPISODES, SAMPLES),
    "6/10 as much": (6, SAMPLES),
    "one episode": (1, SAMPLES),
    "episodes a quarter as long": (12, SAMPLES // 4),
    "two short episodes": (2, SAMPLES // 4),
}


def run(count: int, seed: int) -> list[Tally]:
    """Score `count` populations and new units of every kind."""
    good = {name: Tally(f"good units, {name}", "known to be good") for name in AMOUNTS}
    bad = {name: Tally(f"badly assembled units, {name}", "known to be bad") for name in AMOUNTS}
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        recorded = population(rng)
        model = scored(recorded)
        for name, (episodes, samples) in AMOUNTS.items():
            for tally, severity in (*[(good[name], 0.0)] * NEW, (bad[name], 1.0)):
                began = time.perf_counter()
                status = new_unit(rng, recorded, model, episodes, samples, severity)
                tally.add(status, time.perf_counter() - began)
    for tally in good.values():
        judge(tally)
    for tally in bad.values():
        tally.note = f"{tally.outcomes[Status.OUTLIER.value]} flagged; beside the others stands what would have been"
    return [*good.values(), *bad.values()]


def judge(tally: Tally) -> None:
    """Count alarms as failures where there are more of them than the stated rate makes likely."""
    alarms, likely = tally.outcomes[Status.OUTLIER.value], int(binom.ppf(CONFIDENCE, tally.tried, RATE))
    tally.note = f"{alarms} flagged, at the stated rate of {100 * RATE:g} % up to {likely} are likely"
    if alarms > likely:
        tally.failures["false alarms beyond the stated rate"] = tally.outcomes.pop(Status.OUTLIER.value)


def scored(recorded: Recorded) -> OutlierModel:
    """Score the units of a population as a study does."""
    evidence = list(recorded.units.values())
    models = recorded.models
    return score_outliers(
        recorded.response(evidence),
        FREQS,
        unit_ids=models.unit_ids,
        false_alarm_rate=RATE,
    )


def new_unit(
    rng: np.random.Generator, recorded: Recorded, model: OutlierModel, episodes: int, samples: int, severity: float
) -> str:
    """Record, identify and score one new unit; return what is said about it."""
    evidence = Evidence.of(record(rng, plant(rng, severity), episodes, samples), recorded.models, {})
    score = model.score("new", recorded.response([evidence])[0])
    return recorded.qualified(score, evidence).status.value


def population(rng: np.random.Generator) -> Recorded:
    """Record good units."""
    factors = [record(rng, plant(rng, 0.0), EPISODES, SAMPLES) for _ in range(UNITS)]
    n, peak = len(factors), np.max([f.peak.max(axis=0) for f in factors], axis=0)
    models = ModelSet(
        name="linear_edmd",
        condition="all",
        lifting=LIFTING,
        channels=(
            Channel("position", Role.STATE, "", True),
            Channel("velocity", Role.STATE, "", False),
            Channel("torque", Role.INPUT, "", True),
        ),
        sample_period_s=PERIOD_S,
        unit_ids=tuple(f"{k:02d}" for k in range(n)),
        A=np.zeros((n, 2, 2)),
        B=np.zeros((n, 2, 1)),
        parameters={},
        output_scale=peak[:2],
        input_scale=peak[2:],
        alpha=10.0,
    )
    return Recorded(
        models, {u: Evidence.of(f, models, {}) for u, f in zip(models.unit_ids, factors, strict=True)}, FREQS
    )


def plant(rng: np.random.Generator, severity: float) -> tuple[Array, Array]:
    """Return a sampled drive under position control; a bad one has half the torque and four times the friction."""
    inertia, friction, torque, stiffness = np.array([1.0, 3.0, 40.0, 60.0]) * np.exp(0.05 * rng.normal(size=4))
    friction, torque = friction * (1 + 3 * severity), torque * (1 - 0.5 * severity)
    a = np.array([[0.0, 1.0], [-stiffness / inertia, -friction / inertia]])
    step = expm(np.block([[a, np.array([[0.0], [torque / inertia]])], [np.zeros((1, 3))]]) * PERIOD_S)
    return step[:2, :2], step[:2, 2:]


def record(rng: np.random.Generator, system: tuple[Array, Array], episodes: int, samples: int) -> Factor:
    """Simulate episodes with disturbances and measurement noise, and reduce them."""
    A, B = system
    factors = []
    for _ in range(episodes):
        u = np.repeat(rng.normal(size=(-(-samples // 10), 1)), 10, axis=0)[:samples]
        x = np.zeros((samples, 2))
        force = rng.normal(size=(samples, 2)) * (0.0, 0.05)
        for k in range(samples - 1):
            x[k + 1] = A @ x[k] + B @ u[k] + force[k]
        factors.append(reduce_episode(x + rng.normal(size=x.shape) * (1e-4, 1e-2), u, LIFTING))
    return Factor.stack(factors)


if __name__ == "__main__":
    main("outliers", "Outlier scores of good and of bad units, recorded as much as the others and less", run, 100)
