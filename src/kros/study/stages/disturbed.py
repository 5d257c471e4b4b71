"""Observers of a study on disturbed measurements: which ones, on which episodes, and what the records say about them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import save_artifact
from ...data import EpisodeBatch
from ...data.population import EpisodeKey, Population
from ...design.estimators import Baseline
from ...design.synthesize import measurement_noise
from ...design.task import split_name
from ...evaluate import Disturbance, DisturbedEpisodes, Kind, robustness_rows, standard_disturbances, unit_interval
from ...evaluate.disturb import Measured
from ...evaluate.intervals import draw_interval
from ...evaluate.sensor import as_shown
from ...observer import Observer, run_observers
from ...observer.sensor import Sensors
from ..config import EvaluateConfig
from ..engine.context import Context
from .members import member_work
from .together import alike

Array = npt.NDArray[np.float64]
FEW_UNITS, FEW_S, ALL_S = 3, 3.0, 10.0
NOISE_DRAWS = 6
_FEWEST_DRAWS = 2


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


def make_trial(context: Context, keys: Sequence[EpisodeKey], units: dict[str, dict[str, float]], roles: Mapping[str, str]) -> Trial | None:
    """Return what is run on disturbed measurements; None where the study asks for nothing of it."""
    config = context.config.evaluate
    if not (config.robustness or config.monte_carlo):
        return None
    everything = config.robustness == "all"
    record = context.observers_record
    kind = split_name(str(record["deployed"]))[0]
    names = tuple(name for name in record["names"] if everything or split_name(name)[0] == kind)
    models = context.identified.models()
    firsts = {(k.unit, k.condition): k for k in reversed(keys) if roles[k.unit] != "outlier"}
    chosen = [k for k in keys if firsts.get((k.unit, k.condition)) == k and (everything or k.condition == context.facts.identify_on)]
    dt = context.population.sample_period_s
    given = tuple(chosen if everything else sorted(chosen, key=lambda k: roles[k.unit] != "nominal")[:FEW_UNITS])
    if not given:
        return None
    calibrated = any(units.values())
    disturbances = tuple(standard_disturbances([k for k in Kind if calibrated or k is not Kind.PHASE])) if config.robustness else ()
    if config.monte_carlo:
        disturbances += noise_draws(context, given, models.measured)
    samples = round((ALL_S if everything else FEW_S) / dt)
    return Trial(context.population, given, samples, units, models.measured, disturbances, names, context.config.sensor)


def noise_draws(context: Context, keys: Sequence[EpisodeKey], measured: Sequence[int]) -> tuple[Disturbance, ...]:
    """Return realisations of the noise that the study assumes, as declared or that of the quantisation; the largest share of a largest value counts."""
    noise = measurement_noise(context.identified, context.identified.models(), context.config.sensor)
    y = np.concatenate([context.population.read_parts(k)[0][:, list(measured)] for k in keys])
    size = np.abs(y).max(axis=0)
    severity = float(np.max(noise / np.where(size > 0, size, np.inf)))
    return tuple(Disturbance(Kind.NOISE, severity, draw) for draw in range(1, NOISE_DRAWS + 1))


def run_disturbed(
    context: Context, trial: Trial | None, observers: Mapping[str, Observer], baselines: Mapping[str, tuple[Array, Sequence[int] | None]]
) -> None:
    """Run the observers of a trial on disturbed measurements and on random members of their set, and save what comes out."""
    if trial is None:
        return
    config, folder = context.config.evaluate, context.store.draft("disturbed")
    chosen = {name: observer for name, observer in observers.items() if name in trial.names}
    groups = alike(chosen.values())
    kinds = list(dict.fromkeys(split_name(name)[0] for name in chosen)) if config.monte_carlo else []
    work: list[Callable[[], Any]] = [partial(trial.errors_of_observers, group) for group in groups]
    work += [member_work(context, kind, config.monte_carlo) for kind in kinds]
    done = context.work.run("disturb", work)
    by_name = {o.name: found for group, errors in zip(groups, done, strict=False) for o, found in zip(group, errors, strict=True)}
    errors = {name: (by_name[observer.name], None) for name, observer in chosen.items()} | dict(baselines)
    members = {name: found for of_kind in done[len(groups) :] for name, found in of_kind.items()}
    arrays = {f"{what}/{name}": values for name, (_, parts) in members.items() for what, values in parts.items()}
    save_artifact(folder, "disturbed", contents(trial, config, errors, [row for row, _ in members.values()]), arrays)


def contents(
    trial: Trial, config: EvaluateConfig, errors: Mapping[str, tuple[Array, Sequence[int] | None]], sets: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return what the records say; what was not asked for is absent."""
    episodes, channels = trial.episodes(), trial.population.states
    content: dict[str, Any] = {
        "units": list(dict.fromkeys(k.unit for k in trial.keys)),
        "seconds": trial.samples * trial.population.sample_period_s,
    }
    if config.robustness:
        content["robustness"] = [
            row for name, (found, own) in errors.items() for row in robustness_rows(name, found, episodes, channels, own)
        ]
    if config.monte_carlo:
        noise = [row for name, (found, own) in errors.items() for row in noise_rows(name, found, trial, own)]
        content["monte_carlo"] = {"members": config.monte_carlo, "sets": sets, "noise": noise}
    return content


def noise_rows(name: str, errors: Array, trial: Trial, estimated: Sequence[int] | None) -> list[dict[str, Any]]:
    """Return mean errors over units under fresh measurement noise, with their 95 % intervals: over the noise, over the units, over both."""
    draws = [i for i, d in enumerate(trial.disturbances, 1) if d.draw]
    if len(draws) < _FEWEST_DRAWS:
        return []
    rows = []
    for condition in dict.fromkeys(k.condition for k in trial.keys):
        chosen = [i for i, k in enumerate(trial.keys) if k.condition == condition]
        found = errors[draws][:, chosen]  # (draw, unit, n), one episode a unit
        for j in range(found.shape[-1]) if estimated is None else estimated:
            row: dict[str, Any] = {"observer": name, "condition": condition, "channel": trial.population.states[j], "units": len(chosen)}
            rows.append(row | _intervals(found[..., j]))
    return rows


def _intervals(values: Array) -> dict[str, Any]:
    """Mean and intervals of errors, shape (draw, unit); None where an estimate diverged or there is one unit only."""
    if not np.isfinite(values).all():
        return dict.fromkeys(("error_percent", "over_noise", "over_units", "over_both"))
    several = values.shape[1] > 1
    means = values.mean(axis=1)
    return {
        "error_percent": float(means.mean()),
        "over_noise": [float(q) for q in np.quantile(means, [0.025, 0.975])],
        "over_units": [float(q) for q in unit_interval(values.mean(axis=0))] if several else None,
        "over_both": [float(q) for q in draw_interval(values)] if several else None,
    }
