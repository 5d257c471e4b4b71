"""Observers of a study on disturbed measurements: which ones, on which episodes, and what the records say about them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import save_artifact
from ...data import EpisodeBatch
from ...data.population import EpisodeKey, Population
from ...design.baselines import Baseline
from ...design.task import split_name
from ...evaluate import Disturbance, DisturbedEpisodes, Kind, robustness_rows, standard_disturbances
from ...evaluate.disturb import Measured
from ...evaluate.sensor import as_shown
from ...observer import Observer, run_observers
from ...observer.sensor import Sensors
from ..engine.context import Context

Array = npt.NDArray[np.float64]
FEW_UNITS, FEW_SAMPLES = 3, 3_000
_SIDE_BY_SIDE = 8  # observers of one piece of work: few enough to keep all processes busy


@dataclass(frozen=True, eq=False)
class Trial:
    """Disturbed runs of a study."""

    population: Population
    keys: tuple[EpisodeKey, ...]
    samples: int
    units: dict[str, dict[str, float]]
    measured: tuple[int, ...]
    disturbances: tuple[Disturbance, ...]
    names: tuple[str, ...]
    sensor: Sensors = field(default_factory=dict)

    def episodes(self) -> DisturbedEpisodes:
        """Read the episodes."""
        batch = EpisodeBatch.read(self.population, self.keys, self.samples, self.units)
        batch = as_shown(batch, self.sensor, self.population.states)
        return DisturbedEpisodes(batch, self.measured, self.disturbances)

    def errors_of_observers(self, observers: Sequence[Observer]) -> list[Array]:
        """Return the errors of observers that can run side by side, each of shape (1 + disturbance, episode, n)."""
        lifted = bool(observers[0].lifting.parameters)

        def run(given: Measured, u: Array) -> Array:
            return run_observers(observers, given.y, u, given.parameters if lifted else None)

        return list(self.episodes().errors(run, len(observers)))

    def errors_of_baseline(self, baseline: Baseline) -> Array:
        """Return the same of a baseline; NaN for states that it does not estimate."""
        episodes = self.episodes()
        keys = episodes.batch.keys

        def run(given: Measured, u: Array) -> list[Array]:
            return [baseline.estimate(keys * (given.y.shape[1] // len(keys)), given.y, u, given.parameters)]

        return np.asarray(episodes.errors(run)[0])


def make_trial(
    context: Context, keys: Sequence[EpisodeKey], units: dict[str, dict[str, float]], roles: Mapping[str, str]
) -> Trial | None:
    """Return what is run on disturbed measurements; None where the study asks for nothing of it."""
    if not context.config.evaluate.robustness:
        return None
    record = context.observers_record
    kind = split_name(str(record["deployed"]))[0]
    names = tuple(name for name in record["names"] if split_name(name)[0] == kind)
    models = context.identified.models()
    firsts = {(k.unit, k.condition): k for k in reversed(keys) if roles[k.unit] != "outlier"}
    chosen = [k for k in keys if firsts.get((k.unit, k.condition)) == k and k.condition == context.facts.identify_on]
    given = tuple(sorted(chosen, key=lambda k: roles[k.unit] != "nominal")[:FEW_UNITS])
    if not given:
        return None
    calibrated = any(units.values())
    disturbances = tuple(standard_disturbances([k for k in Kind if calibrated or k is not Kind.PHASE]))
    return Trial(
        context.population, given, FEW_SAMPLES, units, models.measured, disturbances, names, context.config.sensor
    )


def run_disturbed(
    context: Context,
    trial: Trial | None,
    observers: Mapping[str, Observer],
    baselines: Mapping[str, tuple[Array, Sequence[int] | None]],
) -> None:
    """Run the observers of a trial on disturbed measurements, and save what comes out."""
    if trial is None:
        return
    folder = context.store.draft("disturbed")
    chosen = {name: observer for name, observer in observers.items() if name in trial.names}
    groups = alike(chosen.values())
    done = context.work.run("disturb", [partial(trial.errors_of_observers, group) for group in groups])
    by_name = {
        o.name: found
        for group, errors in zip(groups, done, strict=True)
        for o, found in zip(group, errors, strict=True)
    }
    errors = {name: (by_name[observer.name], None) for name, observer in chosen.items()} | dict(baselines)
    save_artifact(folder, "disturbed", contents(trial, errors))


def contents(trial: Trial, errors: Mapping[str, tuple[Array, Sequence[int] | None]]) -> dict[str, Any]:
    """Return what the records say."""
    episodes, channels = trial.episodes(), trial.population.states
    return {
        "units": list(dict.fromkeys(k.unit for k in trial.keys)),
        "seconds": trial.samples * trial.population.sample_period_s,
        "robustness": [
            row
            for name, (found, own) in errors.items()
            for row in robustness_rows(name, found, episodes, channels, own)
        ],
    }


def alike(observers: Iterable[Observer]) -> list[list[Observer]]:
    """Return observers in groups that can run side by side: of one lifting, with the same parameters, measured states and inputs."""
    groups: list[list[Observer]] = []
    for observer in observers:
        key = _model_of(observer)
        group = next((g for g in groups if len(g) < _SIDE_BY_SIDE and _model_of(g[0]) == key), None)
        if group is None:
            groups.append([observer])
        else:
            group.append(observer)
    return groups


def _model_of(observer: Observer) -> tuple[Any, ...]:
    return observer.lifting, dict(observer.parameters), observer.measured, observer.inputs
