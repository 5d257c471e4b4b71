"""Errors of observers, baselines and models on held-out episodes, and trajectories for figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from ..core import Array, frozen
from ..data import EpisodeBatch, EpisodeKey, Population
from ..identify import ModelSet, free_run
from ..observer import Observer, Sensors
from ..observer.simulate import run_observers
from .errors import ErrorSummary, TrueErrors, joined, summarise, true_errors
from .sensor import as_shown

Run = Callable[[Sequence[EpisodeKey], Array, Array, Mapping[str, Array]], Iterable[Array]]
SIDE_BY_SIDE = 16  # episodes
_TOGETHER = 8  # observers, at most
_NUMBERS = 4_000_000  # of estimates that are in memory, 32 MB: memory of that size is used again


def observers_run(observers: Sequence[Observer]) -> Run:
    """Return what runs observers that `alike` puts together, as many at once as fill a memory."""

    def run(keys: Sequence[EpisodeKey], y: Array, u: Array, values: Mapping[str, Array]) -> Iterator[Array]:
        count = max(1, _NUMBERS // (y.shape[0] * y.shape[1] * observers[0].lifting.n_states))
        for start in range(0, len(observers), count):
            yield run_observers(observers[start : start + count], y, u, observers[0].own(values))

    return run


def alike(observers: Iterable[Observer]) -> list[list[Observer]]:
    """Return observers in groups that can run side by side: of one lifting, parameters, measured states and inputs."""
    groups: dict[Any, list[Observer]] = {}
    for o in observers:
        groups.setdefault((o.lifting, tuple(o.parameters.items()), o.measured, o.inputs), []).append(o)
    return [g[start : start + _TOGETHER] for g in groups.values() for start in range(0, len(g), _TOGETHER)]


@frozen
class Outcome:
    """What one observer, baseline or model did."""

    summary: ErrorSummary
    shown: list[Array]
    true: TrueErrors | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    estimated: tuple[int, ...] | None = None  # states; all by default

    @classmethod
    def joined(cls, parts: Sequence[Outcome], order: Sequence[int]) -> Outcome:
        """Join outcomes of episodes; `order` is that in which pieces are displayed."""
        pieces, true = [piece for part in parts for piece in part.shown], [p.true for p in parts if p.true is not None]
        summary = joined([part.summary for part in parts], "rms", "percent", "spectra")
        shown = [pieces[i] for i in order]
        return cls(summary, shown, joined(true, "rms", "error_percent", "lag_s") if true else None)


@frozen
class HeldOut:
    """Held-out episodes as the sensor shows them, with lifting parameters by unit; `shown` are displayed."""

    population: Population
    keys: tuple[EpisodeKey, ...]
    parameters: Mapping[str, dict[str, float]]
    shown: tuple[int, ...] = ()
    sensor: Sensors = field(default_factory=dict)

    def observers(self, observers: Sequence[Observer]) -> list[Outcome]:
        """Run observers that `alike` puts together."""
        return self.estimates(observers_run(observers), observers[0].measured)

    def estimates(self, run: Run, measured: Sequence[int]) -> list[Outcome]:
        """Run estimators on what the sensor shows of the measured states."""
        return self.outcomes(
            lambda batch: run(batch.keys, batch.measurements(measured), batch.inputs, batch.parameters)
        )

    def models(self, models: ModelSet) -> Outcome:
        """Run every unit's model freely from the true first state, with delays from the first recorded ones."""

        def run(batch: EpisodeBatch) -> list[Array]:
            rows = [models.index(k.unit) for k in batch.keys]
            values = batch.parameters if models.lifting.parameters else {}
            first, inputs = batch.first_states(models.lifting.history), np.swapaxes(batch.inputs, 0, 1)
            states = free_run(models.A[rows], models.B[rows], models.lifting, values, first, inputs)
            return [np.swapaxes(states, 0, 1)[None]]

        (outcome,) = replace(self, sensor={}).outcomes(run, truths=False)
        return outcome

    def outcomes(self, run: Callable[[EpisodeBatch], Iterable[Array]], truths: bool = True) -> list[Outcome]:
        """Return the outcomes of estimates, (estimate, n_samples, batch, n or more), some episodes after others."""
        blocks, order = [], list[int]()
        for start in range(0, len(self.keys) or 1, SIDE_BY_SIDE):  # none at all are refused where they are read
            batch = self.read(self.keys[start : start + SIDE_BY_SIDE], truths)
            shown = [i for i in self.shown if start <= i < start + len(batch.keys)]
            order += shown
            rows = [i - start for i in shown]
            blocks.append([one for estimates in run(batch) for one in self._of_block(estimates, batch, rows)])
        places = [order.index(i) for i in self.shown]
        return [Outcome.joined(parts, places) for parts in zip(*blocks, strict=True)]

    def read(self, keys: Sequence[EpisodeKey], truths: bool = False) -> EpisodeBatch:
        """Read episodes as the sensor shows them."""
        batch = EpisodeBatch.read(self.population, keys, None, self.parameters, truths)
        batch = as_shown(batch, self.sensor, self.population.states)
        states = np.ascontiguousarray(batch.states.swapaxes(1, 2)).swapaxes(1, 2)  # in memory as estimates are
        return replace(batch, states=states)

    def _of_block(self, estimates: Array, batch: EpisodeBatch, rows: Sequence[int]) -> list[Outcome]:
        n, lengths, dt = len(self.population.states), batch.lengths, self.population.sample_period_s
        outcomes = []
        for summary, estimate in zip(summarise(estimates, batch.states, lengths, dt), estimates, strict=True):
            shown = [estimate[: lengths[i], i, :n].copy() for i in rows]
            outcomes.append(Outcome(summary, shown, self.true(estimate[..., :n], batch)))
        return outcomes

    def true(self, signals: Array, batch: EpisodeBatch) -> TrueErrors | None:
        """Return the errors of signals against the true states; None where recordings do not hold them."""
        if batch.truths is None:
            return None
        dt, states = self.population.sample_period_s, self.population.true_states
        return true_errors(signals, batch.truths, states, batch.lengths, dt)

    @property
    def groups(self) -> dict[tuple[str, str], list[int]]:
        """Places of the episodes of every unit and condition."""
        groups: dict[tuple[str, str], list[int]] = {}
        for i, key in enumerate(self.keys):
            groups.setdefault((key.unit, key.condition), []).append(i)
        return groups

    def rows(
        self, name: str, outcome: Outcome, roles: Mapping[str, str], band: tuple[float, float] | None
    ) -> list[dict[str, Any]]:
        """Return a row for every unit, condition and estimated channel: means over the unit's episodes."""
        summary, states = outcome.summary, self.population.states
        power, rows = None if band is None else summary.band_power(band), list[dict[str, Any]]()
        for (unit, condition), places in self.groups.items():
            for j in range(len(states)) if outcome.estimated is None else sorted(outcome.estimated):
                row = {"observer": name, "unit": unit, "role": roles[unit], "condition": condition}
                row |= {"channel": states[j], "rms": summary.rms[places, j].mean()}
                row["error_percent"] = summary.percent[places, j].mean()
                row |= {} if power is None else {"gearbox_band_power": power[places, j].mean()}
                rows.append(row | _true_entry(outcome.true, places, j))
        return rows

    def recorded_rows(self, roles: Mapping[str, str]) -> dict[str, list[dict[str, Any]]]:
        """Return the errors of the recorded states themselves against the true ones, where recordings hold them."""
        rows: list[dict[str, Any]] = []
        for (unit, condition), places in self.groups.items() if self.population.truths else ():
            batch = EpisodeBatch.read(self.population, [self.keys[i] for i in places], truths=True)
            true = self.true(batch.states, batch)
            for j in self.population.true_states:
                row = {"unit": unit, "role": roles[unit], "condition": condition}
                row |= {"channel": self.population.states[j]}
                rows.append(row | _true_entry(true, range(len(places)), j))
        return {"recorded": rows} if rows else {}


def _true_entry(true: TrueErrors | None, episodes: Sequence[int], state: int) -> dict[str, float]:
    """Return errors and lag against a true state, mean over episodes; empty where it is not recorded."""
    if true is None or state not in true.states:
        return {}
    at = true.states.index(state)
    return {f"true_{what}": float(v[episodes, at].mean()) for what, v in vars(true).items() if what != "states"}
