"""Observers of a study on disturbed measurements: which ones, on which episodes, and their errors."""

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
from ...observer import Observer
from ...observer.sensor import Sensors
from ...observer.simulate import run_observers
from ..engine.context import Context

Array = npt.NDArray[np.float64]
Errors = Mapping[str, tuple[Array, Sequence[int] | None]]  # by observer, with the states that it estimates
_SIDE_BY_SIDE = 8  # observers of one piece of work: few enough to keep all processes busy


@dataclass(frozen=True, eq=False)
class Trial:
    """Episodes of a study on which measurements are disturbed."""

    population: Population
    keys: tuple[EpisodeKey, ...]
    units: Mapping[str, dict[str, float]]
    measured: tuple[int, ...]
    disturbances: tuple[Disturbance, ...]
    kind: str  # of the models whose observers run
    sensor: Sensors = field(default_factory=dict)
    samples: int = 3_000  # of an episode, at most

    def episodes(self) -> DisturbedEpisodes:
        """Read the episodes."""
        batch = EpisodeBatch.read(self.population, self.keys, self.samples, self.units)
        batch = as_shown(batch, self.sensor, self.population.states)
        return DisturbedEpisodes(batch, self.measured, self.disturbances)

    def errors_of_observers(self, observers: Sequence[Observer]) -> list[Array]:
        """Return the errors of observers that can run side by side, each of shape (1 + disturbance, episode, n)."""

        def run(measured: Measured, u: Array) -> Array:
            return run_observers(observers, measured.y, u, observers[0].own(measured.parameters))

        return list(self.episodes().errors(run, len(observers)))

    def errors_of_baseline(self, baseline: Baseline) -> Array:
        """Return the same of a baseline; NaN for states that it does not estimate."""
        episodes = self.episodes()
        keys = episodes.batch.keys

        def run(measured: Measured, u: Array) -> list[Array]:
            return [baseline.estimate(keys * (measured.y.shape[1] // len(keys)), measured.y, u, measured.parameters)]

        return np.asarray(episodes.errors(run)[0])

    def content(self, errors: Errors) -> dict[str, Any]:
        """Return what the records say."""
        episodes, states = self.episodes(), self.population.states
        rows = [
            robustness_rows(name, error, episodes, states, estimated) for name, (error, estimated) in errors.items()
        ]
        seconds = self.samples * self.population.sample_period_s
        units = list(dict.fromkeys(k.unit for k in self.keys))
        return {"units": units, "seconds": seconds, "robustness": [row for part in rows for row in part]}


def make_trial(
    context: Context, keys: Sequence[EpisodeKey], units: Mapping[str, dict[str, float]], roles: Mapping[str, str]
) -> Trial | None:
    """Return what runs on disturbed measurements of a few units; None where the study asks for nothing of it."""
    few, config = 3, context.config
    firsts = {k.unit: k for k in reversed(keys) if k.condition == context.facts.identify_on}
    chosen = sorted((k for u, k in firsts.items() if roles[u] != "outlier"), key=keys.index)
    chosen = sorted(chosen, key=lambda k: roles[k.unit] != "nominal")[:few]
    if not config.evaluate.robustness or not chosen:
        return None
    disturbances = tuple(standard_disturbances([k for k in Kind if any(units.values()) or k is not Kind.PHASE]))
    kind, measured = split_name(str(context.observers_record["deployed"]))[0], context.identified.models().measured
    return Trial(context.population, tuple(chosen), units, measured, disturbances, kind, config.sensor)


def run_disturbed(context: Context, trial: Trial | None, observers: Mapping[str, Observer], baselines: Errors) -> None:
    """Run the observers of a trial on disturbed measurements, and save their errors."""
    if trial is None:
        return
    chosen = {name: observer for name, observer in observers.items() if split_name(name)[0] == trial.kind}
    groups = alike(chosen.values())
    results = context.work.run("disturb", [partial(trial.errors_of_observers, group) for group in groups])
    by_name = {
        o.name: one for group, errors in zip(groups, results, strict=True) for o, one in zip(group, errors, strict=True)
    }
    errors = {name: (by_name[observer.name], None) for name, observer in chosen.items()} | dict(baselines)
    save_artifact(context.store.draft("disturbed"), "disturbed", trial.content(errors))


def alike(observers: Iterable[Observer]) -> list[list[Observer]]:
    """Return observers in groups that can run side by side: of one lifting, parameters, measured states and inputs."""
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
