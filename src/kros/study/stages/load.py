"""Load torque in a study: calibrated where a load of known size is mounted, judged on held-out episodes of all other units.

Needs ``[load] moment``. Observers with a load of their own are made of both liftings, the linear one for comparison; beside them stands the paper's
estimate, the error of the recorded current that observers of the unloaded machine make. The declared load is the truth for the other units as
well: it is meant for loads that are alike.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import load_artifact, save_artifact
from ...core.errors import ConfigError, KrosError
from ...data import EpisodeBatch
from ...data.population import EpisodeKey
from ...design.validation import seen_by
from ...evaluate.sensor import as_arriving
from ...lifting import Lifting
from ...motor_drive import AngleLoad, LoadSettings, TorqueScale, known_load, load_observer
from ...motor_drive.signals import load_accuracy, low_passed
from ...observer import Observer, run_observer
from ..config import LoadConfig
from ..engine.context import Context
from . import calibrate

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
FOLDER = KIND = "load"
REAL_HZ, SETTLE_S = 20.0, 2.0
_KNOWN, _UNAWARE = 2, "worst_case_h2"


def wanted(config: LoadConfig) -> bool:
    """Whether the study declares a load."""
    return config.moment is not None


def run_load(context: Context, observers: Mapping[str, Observer]) -> None:
    """Make and judge the estimators of the load and save what was found; nothing where the study declares no load."""
    if not wanted(context.config.load):
        return
    study = LoadStudy(context)
    rows: list[dict[str, Any]] = []
    curves: dict[str, Array] = {}
    facts: dict[str, dict[str, Any]] = {}
    for kind, lifting in study.liftings().items():
        try:
            observer, left_out = study.observer(f"{kind}/load", lifting)
            observer = replace(observer, seen=seen_by(context.identified, observer.measured))
        except KrosError as error:
            facts[f"{kind}/load"] = {"status": "failed", "reason": str(error)}
            log.info("%s/load could not be made: %s", kind, error)
            continue
        observer.save(context.store.draft(FOLDER, f"{kind}.json"))
        estimate = run_observer(
            observer, study.measured(study.test), study.test.inputs, study.parameters(observer, study.test)
        )
        found = study.level(observer, estimate)
        facts[f"{kind}/load"] = {"order": observer.internal, "episodes_left_out": len(left_out)}
        rows.append(study.row(f"{kind}/load", found))
        curves[f"{kind}/load"] = found
    for name in (f"{kind}/{_UNAWARE}" for kind in study.liftings() if f"{kind}/{_UNAWARE}" in observers):
        try:
            found = study.from_current(observers[name])
        except KrosError as error:
            facts[f"{name}/current"] = {"status": "failed", "reason": str(error)}
            continue
        rows.append(study.row(f"{name}/current", found))
        curves[f"{name}/current"] = found
    content = {"known": study.known, "rows": rows, "observers": facts, "corner_hz": 5.0, "settle_s": SETTLE_S}
    shown = int(np.flatnonzero(study.loaded)[0])
    key = study.test.keys[shown]
    arrays = {
        "truth": study.truth[1][:, shown],
        **{f"estimate/{name}": values[:, shown] for name, values in curves.items()},
    }
    save_artifact(
        context.store.draft(FOLDER),
        KIND,
        content | {"shown": [key.unit, key.condition, key.episode], "estimates": list(curves)},
        {name: values.astype(np.float32) for name, values in arrays.items()},
    )


def load_metrics(context: Context) -> dict[str, Any]:
    """Return what `metrics.json` says of the load; nothing where the study declares none."""
    if not wanted(context.config.load):
        return {}
    content = load_artifact(context.store.path(FOLDER), KIND)[0]
    return {"load_torque": {key: content[key] for key in ("known", "corner_hz", "settle_s", "observers", "rows")}}


class LoadStudy:
    """Recordings of a study with the load that is declared."""

    def __init__(self, context: Context) -> None:
        self.context, self.config = context, context.config.load
        facts, config = context.facts, self.config
        phases = calibrate.load(context)
        usable = [u for u in facts.pooled if phases is None or u in phases.units]
        self.units = {u: {} if phases is None else {phases.spec.parameter: phases.units[u].phase_rad} for u in usable}
        self.known = list(config.units) or [u for u in usable if facts.keys("train", u, config.condition)][:_KNOWN]
        others = [u for u in usable if u not in self.known]
        if (
            not set(self.known) <= set(usable)
            or not self.known
            or not any(facts.keys("test", u, config.condition) for u in others)
        ):
            raise ConfigError(
                f"Load: needs units with a known load and others to judge on, both recorded in condition {config.condition!r}; "
                f"known {', '.join(self.known) or 'none'}, others {', '.join(others[:10]) or 'none'}; see load.units and load.condition."
            )
        free = facts.identify_on
        train = [
            k
            for k in facts.train
            if k.unit in usable and (k.condition == free or (k.condition == config.condition and k.unit in self.known))
        ]
        test = [k for k in facts.test if k.unit in others and k.condition in (free, config.condition)]
        self.train, self.test = self.read(train), self.read(test)
        self.dt = context.population.sample_period_s
        self.truth = [self.load(batch) for batch in (self.train, self.test)]
        self.loaded = np.array([k.condition == config.condition for k in test])

    def read(self, keys: list[EpisodeKey]) -> EpisodeBatch:
        """Read episodes, all cut to the shortest."""
        population = self.context.population
        batch = EpisodeBatch.read(population, keys, parameters=self.units)
        return batch if np.all(batch.lengths == batch.lengths[0]) else batch.head(int(batch.lengths.min()))

    @property
    def places(self) -> tuple[int, int]:
        """Places of angle and current among the states."""
        states = self.context.population.states
        for name in (self.config.angle, self.config.current):
            if name not in states:
                raise ConfigError(
                    f"Load: there is no state {name!r} in {', '.join(states)}; set load.angle and load.current."
                )
        return states.index(self.config.angle), states.index(self.config.current)

    def load(self, batch: EpisodeBatch) -> Array:
        """Return the declared load, in units of current, zero in other conditions."""
        config, angle = self.config, self.places[0]
        torque = known_load(
            batch.states[..., angle], self.dt, float(config.moment or 0.0), config.inertia, corner_hz=REAL_HZ
        )
        return np.where([k.condition == config.condition for k in batch.keys], torque, 0.0)

    def liftings(self) -> dict[str, Lifting]:
        """Liftings that are compared."""
        lifting = self.context.lifting
        linear = {"linear": Lifting(self.context.population.states)}
        return {"koopman": lifting, **linear} if lifting.functions else linear

    def measured(self, batch: EpisodeBatch) -> Array:
        """What is measured at run time."""
        return np.asarray(batch.states[..., list(self._measured)])

    @property
    def _measured(self) -> tuple[int, ...]:
        return self.context.identified.models(self.context.identified.kinds[0]).measured

    def parameters(self, made: Observer | Lifting, batch: EpisodeBatch) -> dict[str, Array] | None:
        """Lifting parameters of a batch, where a lifting has any."""
        lifting = made.lifting if isinstance(made, Observer) else made
        return batch.parameters if lifting.parameters else None

    def observer(self, name: str, lifting: Lifting) -> tuple[Observer, tuple[int, ...]]:
        """Estimator of the load, and the episodes that are left out."""
        settings = LoadSettings(self.places[1], self.config.level_s, REAL_HZ, self.config.limit)
        inputs = self.context.population.inputs
        return load_observer(name, lifting, self._measured, inputs, self.train, self.truth[0], settings)

    def level(self, observer: Observer, estimate: Array) -> Array:
        """Load estimates with their level."""
        angle, current = self.places
        limit = np.inf if self.config.limit is None else self.config.limit
        leveled = AngleLoad(self.config.level_s, self.dt, limit=limit)
        seen = estimate[..., observer.lifting.states.index("load")]
        return leveled.run(seen, estimate[..., current], self.test.states[..., angle]).load

    def from_current(self, observer: Observer) -> Array:
        """The paper's estimate."""
        current, errors = self.places[1], []
        for batch in (self.train, self.test):
            y = as_arriving(batch, observer.sensor, self.context.population.states).measurements(observer.measured)
            estimate = run_observer(observer, y, batch.inputs, self.parameters(observer, batch))
            errors.append(batch.states[..., current] - estimate[..., current])
        loaded = [i for i, k in enumerate(self.train.keys) if k.condition == self.config.condition]
        return TorqueScale.calibrated(errors[0][:, loaded], self.truth[0][:, loaded], self.dt).load(errors[1])

    def row(self, name: str, estimate: Array) -> dict[str, Any]:
        """Errors of an estimate for the metrics."""
        accuracy = load_accuracy(estimate, self.truth[1], self.dt, skip=round(SETTLE_S / self.dt))
        fast = estimate - low_passed(estimate, REAL_HZ, self.dt)
        return {
            "observer": name,
            "load_rms": accuracy.load_rms,
            "floor_rms": accuracy.floor_rms,
            "error_rms": accuracy.error_rms,
            "error_percent": accuracy.percent,
            "error_to_floor": accuracy.ratio,
            "fast_rms": {
                "unloaded": float(np.std(fast[:, ~self.loaded])),
                "loaded": float(np.std(fast[:, self.loaded])),
            },
        }
