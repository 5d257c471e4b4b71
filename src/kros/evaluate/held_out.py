"""Errors of observers, baselines and models on held-out episodes, and trajectories for figures."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field, replace

import numpy as np

from ..core import Array, ByName, Columns, Record, frozen, grouped
from ..core.linalg import pieces
from ..data import EpisodeBatch, EpisodeKey, Population
from ..data.population import Keys
from ..identify import ModelSet, free_run
from ..observer import Observer, Sensors
from ..observer.simulate import run_observers
from .errors import errors_of, true_errors
from .sensor import as_shown

Run = Callable[[Sequence[EpisodeKey], Array, Array, Mapping[str, Array]], Iterable[Array]]
SIDE_BY_SIDE = 16  # episodes
_TOGETHER = 8  # observers, at most


def alike(observers: Iterable[Observer]) -> list[list[Observer]]:
    """Return observers in groups that can run side by side: of one lifting, parameters, measured states and inputs."""
    groups = grouped(observers, lambda o: (o.lifting, tuple(o.parameters.items()), o.measured, o.inputs))
    return [group[part] for group in groups.values() for part in pieces(len(group), _TOGETHER)]


@frozen
class Outcome:
    """What one observer, baseline or model did on some episodes; one that could not be made has facts alone."""

    errors: dict[EpisodeKey, list[Record]] = field(default_factory=dict)  # by state, and by key in the metrics
    shown: dict[EpisodeKey, Array] = field(default_factory=dict)  # estimates, (n_samples, n)
    facts: ByName = field(default_factory=dict)
    estimated: Columns | None = None  # states; all by default


@frozen
class HeldOut:
    """Held-out episodes as the sensor shows them, with lifting parameters by unit; `shown` are displayed."""

    population: Population
    keys: Keys
    parameters: Mapping[str, dict[str, float]]
    shown: Keys = ()
    sensor: Sensors = field(default_factory=dict)
    band_hz: tuple[float, float] | None = None  # in which the power of errors is known as well

    def observers(self, observers: Sequence[Observer]) -> list[Outcome]:
        """Run observers that `alike` puts together."""
        first = observers[0]
        return self.estimates(
            lambda keys, y, u, values: run_observers(observers, y, u, first.own(values)), first.measured
        )

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
            x, inputs = np.swapaxes(batch.states, 0, 1), np.swapaxes(batch.inputs, 0, 1)
            first = x[:, : models.lifting.history + 1]
            states = free_run(models.A[rows], models.B[rows], models.lifting, values, first, inputs)
            return [np.swapaxes(states, 0, 1)]

        (outcome,) = replace(self, sensor={}, band_hz=None).outcomes(run, truths=False)
        return outcome

    def outcomes(self, run: Callable[[EpisodeBatch], Iterable[Array]], truths: bool = True) -> list[Outcome]:
        """Return the outcomes of estimates, (n_samples, batch, n or more) each, some episodes after others."""
        outcomes, n = [], len(self.population.states)
        for part in pieces(len(self.keys) or 1, SIDE_BY_SIDE):  # none at all are refused where they are read
            batch = self.read(self.keys[part], truths)
            shown = [(i, key) for i, key in enumerate(batch.keys) if key in self.shown]
            for place, estimate in enumerate(run(batch)):
                if part.start == 0:
                    outcomes.append(Outcome())
                outcomes[place].errors.update(self.errors(estimate[..., :n], batch))
                outcomes[place].shown.update({key: estimate[: batch.lengths[i], i, :n].copy() for i, key in shown})
        return outcomes

    def read(self, keys: Sequence[EpisodeKey], truths: bool = False) -> EpisodeBatch:
        """Read episodes as the sensor shows them."""
        batch = EpisodeBatch.read(self.population, keys, None, self.parameters, truths)
        batch = as_shown(batch, self.sensor, self.population.states)
        states = np.ascontiguousarray(batch.states.swapaxes(1, 2)).swapaxes(1, 2)  # in memory as estimates are
        return replace(batch, states=states)

    def errors(self, signals: Array, batch: EpisodeBatch) -> dict[EpisodeKey, list[Record]]:
        """Return the errors of signals in every state of episodes, against truths too where recordings hold them."""
        dt, states = self.population.sample_period_s, self.population.true_states
        known = errors_of(signals, batch.states, batch.lengths, dt, self.band_hz)
        errors = [[_at(known, i, j) for j in range(signals.shape[2])] for i in range(len(batch.keys))]
        if batch.truths is not None:
            true = true_errors(signals[..., list(states)], batch.truths, batch.lengths, dt)
            for i, of_states in enumerate(errors):
                for place, j in enumerate(states):
                    of_states[j] |= _at(true, i, place)
        return dict(zip(batch.keys, errors, strict=True))

    @property
    def groups(self) -> dict[tuple[str, str], list[EpisodeKey]]:
        """Episodes of every unit and condition."""
        return grouped(self.keys, lambda key: (key.unit, key.condition))

    def rows(self, name: str, outcome: Outcome, roles: Mapping[str, str]) -> list[Record]:
        """Return a row for every unit, condition and estimated channel: means over the unit's episodes."""
        columns, rows = outcome.estimated, []
        for (unit, condition), keys in self.groups.items() if outcome.errors else ():
            about = {"observer": name, "unit": unit, "role": roles[unit], "condition": condition}
            for j, channel in enumerate(self.population.states):
                if columns is None or j in columns:
                    errors = [outcome.errors[key][j] for key in keys]
                    means = {name: float(np.mean([of[name] for of in errors])) for name in errors[0]}
                    rows.append(about | {"channel": channel} | means)
        return rows

    def recorded(self) -> Outcome:
        """Take the recorded states for estimates: their errors against the true ones are known."""
        (outcome,) = replace(self, sensor={}, band_hz=None, shown=()).outcomes(lambda batch: [batch.states])
        return replace(outcome, estimated=self.population.true_states)


def _at(errors: Mapping[str, Array], episode: int, state: int) -> Record:
    """Return the errors of one state in one episode."""
    return {name: float(values[episode, state]) for name, values in errors.items()}
