"""Load torque in a study: calibrated where a load of known size is mounted, judged on held-out episodes of other units.

Needs ``[load] moment``. Observers with a load as a state are made of both liftings, the linear one for comparison.
Beside them is the paper's estimate, the error of the recorded current in observers of the unloaded machine. The
declared load is the truth for the other units as well: it is meant for loads that are alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from ...core import Array, ConfigError, KrosError, Record, frozen
from ...data import EpisodeBatch, Population, some
from ...design.training import seen_by
from ...evaluate.sensor import as_arriving
from ...lifting import Lifting
from ...motor_drive import AngleLoad
from ...motor_drive.observer import LoadSettings, load_observer
from ...motor_drive.signals import TorqueScale, known_load, load_accuracy
from ...observer import EstimatorSettings, Observer, run_observer
from ...report.run_folder import Shown
from ..config import LoadConfig
from ..engine.context import Context

LOAD = "load"


@frozen
class TrialSettings:
    """How a load is estimated and judged."""

    condition: str = "load"  # in which it is mounted
    angle: str = "position"  # state that is the angle
    current: str = "current"  # state that is the current
    corner_hz: float = 20.0  # of the known load: what is faster, as vibrations of the gear, does not count
    judged_hz: float = 5.0  # up to which errors of the load count
    settle_s: float = 2.0  # of an episode, which is not judged
    known: int = 2  # units on which the load is known, where the study names none
    unaware: str = "worst_case_h2"  # method whose observers estimate a load from the recorded current


TRIAL = TrialSettings()


def require_load(config: LoadConfig, population: Population) -> None:
    """Refuse a declared load of units that were not recorded, or without the states that show it."""
    known = {*population.unit_ids, *population.states}
    missing = [name for name in (*config.units, TRIAL.angle, TRIAL.current) if name not in known]
    if config.moment is not None and missing:
        there = f"{some(population.unit_ids)} or {some(population.states)}"
        raise ConfigError(f"load: there is no unit or state {missing[0]!r} in {there}; correct the name.")


def run_load(context: Context, observers: Mapping[str, Observer]) -> Record:
    """Make and judge the estimators of the load, save them, and return errors; nothing without a declared load."""
    if context.config.load.moment is None:
        return {}
    trial, liftings = LoadTrial.of(context), {"linear": Lifting(context.population.states)}
    if context.lifting.functions:
        liftings = {"koopman": context.lifting, **liftings}
    makers = {f"{kind}/{LOAD}": partial(_with_load, trial, kind, lifting) for kind, lifting in liftings.items()}
    names = [f"{kind}/{TRIAL.unaware}" for kind in liftings]
    makers |= {f"{n}/current": partial(_from_current, trial, observers[n]) for n in names if n in observers}
    curves, facts = {}, {}
    for name, make in makers.items():
        try:
            curves[name], facts[name] = make()
        except KrosError as error:
            facts[name] = {"status": "failed", "reason": str(error)}
    shown = next(i for i, key in enumerate(trial.test.keys) if key.condition == TRIAL.condition)
    key, estimates = trial.test.keys[shown], {n: values[:, [shown]] for n, values in curves.items()}
    signals = trial.truth[1][:, [shown]], trial.test.inputs[:, shown]
    Shown(key, trial.test.sample_period_s, *signals, estimates).save(context.store.draft(LOAD))
    rows = [trial.row(*item) for item in curves.items()]
    settings = {"corner_hz": TRIAL.judged_hz, "settle_s": TRIAL.settle_s}
    return {"load_torque": {"known": trial.known, "rows": rows, "observers": facts, **settings}}


def _with_load(trial: LoadTrial, kind: str, lifting: Lifting) -> tuple[Array, Record]:
    """Return the load of an observer that has it as a state, with its level, and facts; save the observer."""
    context, (angle, current), test = trial.context, trial.places, trial.test
    identified, inputs = context.identified, context.population.inputs
    measured, leveled = identified.models().measured, angle_load(context.config.estimator, test.sample_period_s)
    read = LoadSettings(current, leveled.level_s, TRIAL.corner_hz, leveled.limit)
    observer, left_out = load_observer(f"{kind}/{LOAD}", lifting, measured, inputs, trial.train, trial.truth[0], read)
    nominal = identified.parameters[context.uncertain.nominal]
    seen = seen_by(identified, observer.measured)
    observer = replace(observer, seen=seen, parameters={n: nominal[n] for n in lifting.parameters})
    observer.save(context.store.draft(LOAD, f"{kind}.json"))
    estimate = run_observer(observer, test.measurements(measured), test.inputs, observer.own(test.parameters))
    estimated = estimate[..., observer.lifting.states.index("load")]
    load = leveled.run(estimated, estimate[..., current], test.states[..., angle]).load
    return load, {"order": observer.internal, "episodes_left_out": len(left_out)}


def angle_load(declared: EstimatorSettings, dt: float) -> AngleLoad:
    """Return what fills in the level of a load, up to the limit of the current."""
    ends = declared.limits.get(TRIAL.current, (np.inf,))
    return AngleLoad(LoadSettings.level_s, dt, limit=max(map(abs, ends)))


def _from_current(trial: LoadTrial, observer: Observer) -> tuple[Array, Record]:
    """Return the paper's estimate: the error of the current, scaled where the load is known."""
    current, errors = trial.places[1], []
    for batch in (trial.train, trial.test):
        y = as_arriving(batch, observer.sensor, trial.context.population.states).measurements(observer.measured)
        estimate = run_observer(observer, y, batch.inputs, observer.own(batch.parameters))
        errors.append(batch.states[..., current] - estimate[..., current])
    loaded = [i for i, k in enumerate(trial.train.keys) if k.condition == TRIAL.condition]
    known = errors[0][:, loaded], trial.truth[0][:, loaded]
    return TorqueScale.calibrated(*known, trial.test.sample_period_s).load(errors[1]), {}


@frozen
class LoadTrial:
    """Recordings of a study with the load that is declared."""

    context: Context
    known: list[str]  # units
    train: EpisodeBatch
    test: EpisodeBatch
    truth: list[Array]  # of both, in units of current

    @classmethod
    def of(cls, context: Context) -> LoadTrial:
        """Read the recordings; refuse a study without a known load, or without other units to judge on."""
        facts, population, units = context.facts, context.population, context.identified.parameters
        usable, free, loaded = [u for u in facts.pooled if u in units], facts.identify_on, TRIAL.condition
        known = list(context.config.load.units)
        known = known or [u for u in usable if facts.keys("train", u, loaded)][: TRIAL.known]
        others = [u for u in usable if u not in known]
        if not set(known) <= set(usable) or not known or not any(facts.keys("test", u, loaded) for u in others):
            needs = f"needs units with a known load and others to judge on, both recorded in condition {loaded!r}"
            raise ConfigError(f"Load: {needs}; known {some(known) or 'none'}, others {some(others) or 'none'}.")
        places = {free: usable, loaded: [*known, *(usable if free == loaded else ())]}
        train = [k for k in facts.train if k.unit in places.get(k.condition, ())]
        test = [k for k in facts.test if k.unit in others and k.condition in (free, loaded)]
        batches = [EpisodeBatch.read(population, keys, parameters=units) for keys in (train, test)]
        first, second = (batch.head(int(batch.lengths.min())) for batch in batches)
        return cls(context, known, first, second, [_truth(context, batch) for batch in (first, second)])

    @property
    def places(self) -> tuple[int, int]:
        """Places of angle and current among the states."""
        states = self.context.population.states
        return states.index(TRIAL.angle), states.index(TRIAL.current)

    def row(self, name: str, estimate: Array) -> Record:
        """Return errors of an estimate for the metrics."""
        dt = self.test.sample_period_s
        accuracy = load_accuracy(estimate, self.truth[1], dt, TRIAL.judged_hz, round(TRIAL.settle_s / dt))
        errors = {"error_percent": accuracy.percent, "error_to_floor": accuracy.ratio}
        return {"observer": name, **vars(accuracy), **errors}


def _truth(context: Context, batch: EpisodeBatch) -> Array:
    """Return the load that is declared, on episodes in its condition."""
    config = context.config.load
    position = batch.states[..., context.population.states.index(TRIAL.angle)]
    torque = known_load(position, batch.sample_period_s, config.moment or 0.0, config.inertia, TRIAL.corner_hz)
    return np.where([k.condition == TRIAL.condition for k in batch.keys], torque, 0.0)
