"""The certificate of every observer as it runs, with what it says about training episodes; observers of one lifting run side by side."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import save_artifact
from ..lifting import Lifting
from ..observer import (
    Guard,
    Observer,
    ReliftCertificate,
    ReliftScales,
    ReliftStatus,
    SignalBound,
    relift_certificate,
    run_observer,
    run_observers,
    signal_bound,
)
from ..observer.estimator.certificate import filter_certificate, left_out_bound
from ..observer.residual.one_step import one_step_residual
from ..observer.units import factors
from ..uncertainty.coprime.bands import BandEnergies
from .guard import guarded
from .task import DesignResult, DesignTask
from .validation import SHORT_SAMPLES, TrainingSet, ValidationSet, hidden_mean

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_SAMPLES = 5_000  # of an episode
_LOSS_SAMPLES, _LOSS_SHARE, _LOSS_AFTER, _LOSS_EPISODES = (
    2_000,
    0.4,
    0.25,
    3,
)  # a loss ends there or at that share of an episode; when it begins
DIVERGED = 100.0  # percent of the largest value: an estimate that says nothing
_BOX = 1.5  # operating box in units of the recorded ranges, where a lifting has no global slope bounds


@dataclass(frozen=True, eq=False)
class Running:
    """What is known about one observer as it runs."""

    name: str
    certificate: ReliftCertificate
    hidden_percent: float
    dropout_percent: float
    signals: SignalBound | None = None
    measured: tuple[int, ...] = ()
    guard: Guard | None = None

    @property
    def certified(self) -> bool:
        """Whether it is certified as it runs, for any machine, and for the recorded signals of all units."""
        return self.certificate.certified and (self.signals is None or self.signals.certified)

    def facts(self) -> dict[str, Any]:
        """Return what goes into the metrics."""
        found = self.certificate
        facts: dict[str, Any] = {
            "relift_certified": found.certified,
            "relift_gain": found.gain,
            "hidden_error_percent": self.hidden_percent,
            "blind_error_percent": self.dropout_percent,
        }
        if self.signals is not None:
            facts |= self.signals.facts(self.measured)
        if not found.certified:
            return facts | {"relift_reason": found.reason}
        return facts


def certify_running(task: DesignTask, results: Sequence[DesignResult]) -> list[Running]:
    """Certify observers of one kind of model; `task` is that of any of them, and what could not be made is left out."""
    observers = [found.observer for found in results if found.observer is not None]
    data, others = certified_on(task), other_conditions(task)
    facts = {r.name: r.facts for r in results}
    found = {
        r.name: r
        for group in by_lifting([o for o in observers if o.bank is None])
        for r in running_of(group, data, task, others)
    }
    found |= {o.name: running_filters(o, data, task, others, facts[o.name]) for o in observers if o.bank is not None}
    return [found[observer.name] for observer in observers]


def certified_on(task: DesignTask) -> ValidationSet:
    """Return the episodes whose signals make the set that observers are certified for: the beginning of the first one of every unit, or some short ones."""
    return _beginnings(task.training)


def other_conditions(task: DesignTask) -> list[ValidationSet]:
    """Return the same episodes of the same units for every condition that observers are not certified for, on which they are compared as well."""
    training, recordings = task.training, task.recordings or task.training
    home, units = {k.condition for k in training.keys}, {k.unit for k in training.keys}
    known = [k for k in recordings.keys if k.condition not in home and k.unit in units]
    parts = [
        replace(recordings, keys=tuple(k for k in known if k.condition == c))
        for c in dict.fromkeys(k.condition for k in known)
    ]
    return [_beginnings(part) for part in parts]


def _beginnings(training: TrainingSet) -> ValidationSet:
    first = training.first_of_units().read().first(_SAMPLES)
    return first if len(first.batch.states) > SHORT_SAMPLES else training.read()


def by_lifting(observers: Sequence[Observer]) -> list[list[Observer]]:
    """Return observers in groups that can run side by side: some have been fitted to their own liftings."""
    groups: dict[Lifting, list[Observer]] = {}
    for observer in observers:
        groups.setdefault(observer.lifting, []).append(observer)
    return list(groups.values())


def running_of(
    observers: Sequence[Observer], data: ValidationSet, task: DesignTask, others: Sequence[ValidationSet] = ()
) -> list[Running]:
    """Certify observers of one lifting, and compare with what they do, in other conditions too; certificates come back in the recordings' units."""
    first, batch = observers[0], data.batch
    scales = scales_of(observers, data, task)
    guards = [o.guard for o in guarded(observers, [data, *others])]
    certificates = [certify(observer, own, task) for observer, own in zip(observers, scales, strict=True)]
    estimates = run_observers(observers, data.measurements(first.measured), batch.inputs, first.own(batch.parameters))
    arrived = estimates
    if batch.lost is not None:  # bounds are for measurements that arrive
        y = batch.measurements(first.measured, arrived=False)
        arrived = run_observers(observers, y, batch.inputs, first.own(batch.parameters))
    errors = [data.compare(estimates), *(other.percent_of_all(observers) for other in others)]
    hidden = np.exp(np.mean([np.log(hidden_mean(percent, first.measured)) for percent in errors], axis=0))
    dropout = dropout_error_percent(observers, data)
    known: dict[bytes, BandEnergies] = {}
    bounds = []
    for o, c, x in zip(observers, certificates, arrived, strict=True):
        bounds.append(signal_bound(c, o, batch, x, known))
    bounds = [b.in_sizes(factors(o, {})[0][: len(b.states)]) for o, b in zip(observers, bounds, strict=True)]
    certificates = [c.in_sizes(o, {}) for o, c in zip(observers, certificates, strict=True)]
    found = zip(observers, certificates, hidden, dropout, bounds, guards, strict=True)
    return [Running(o.name, c, float(h), float(d), b, o.measured, g) for o, c, h, d, b, g in found]


def running_filters(
    observer: Observer, data: ValidationSet, task: DesignTask, others: Sequence[ValidationSet], facts: dict[str, Any]
) -> Running:
    """Certify a filter bank; its errors in training are raised to those on units that were left out."""
    batch, n, measured = data.batch, len(observer.recorded), observer.measured
    estimates = run_observer(observer, data.measurements(measured), batch.inputs, observer.own(batch.parameters))
    missed = estimates[..., :n] - batch.states
    inside = (np.arange(len(missed))[:, None] < batch.lengths)[..., None]
    square = np.sum(np.where(inside, missed, 0.0) ** 2, axis=0) / batch.lengths[:, None]
    units = list(dict.fromkeys(batch.units))
    errors = np.sqrt([square[[u == unit for u in batch.units]].mean(axis=0) for unit in units])
    sizes = task.models.output_scale[:n]
    scales = ReliftScales(sizes, np.sqrt(n * square.mean(axis=0)), task.noise * np.sqrt(len(measured)))
    growth = facts["left_out_to_training"]
    grown = np.array([growth.get(name, 1.0) for name in observer.recorded])
    percents = [data.compare([estimates])[0], *(other.percent(observer) for other in others)]
    hidden = float(np.exp(np.mean([np.log(hidden_mean(percent * grown, measured)) for percent in percents])))
    dropout = float(dropout_error_percent([observer], data)[0])
    certificate = filter_certificate(observer, scales)
    bound = left_out_bound(observer, sizes, units, errors, facts["left_out_worst_percent"])
    by = factors(observer, {})[0]
    scales = ReliftScales(scales.error * by[:n], scales.residual * by[:n], scales.noise * by[list(measured)])
    certificate = replace(certificate, scales=scales)
    return Running(observer.name, certificate, hidden, dropout, bound.in_sizes(by[:n]), measured)


def scales_of(observers: Sequence[Observer], data: ValidationSet, task: DesignTask) -> list[ReliftScales]:
    """Return the sizes that every observer's gain refers to: ranges, the residual of its own model in this population, quantisation."""
    known: dict[bytes, ReliftScales] = {}
    for observer in observers:
        model, n = observer.A.tobytes() + observer.B.tobytes(), len(observer.recorded)
        if model not in known:
            batch, values = data.batch, observer.own(data.batch.parameters)
            residual = one_step_residual(observer.lifting, observer.A, observer.B, batch.states, batch.inputs, values)
            known[model] = ReliftScales.typical(task.models.output_scale[:n], residual, task.noise)
    return [known[observer.A.tobytes() + observer.B.tobytes()] for observer in observers]


def dropout_error_percent(observers: Sequence[Observer], data: ValidationSet) -> Array:
    """Return the largest error of a state in percent of the largest value where measurements stop arriving, shape (observer,); infinite where it grows on."""
    some, first = data.part(range(min(_LOSS_EPISODES, len(data.batch.keys)))), observers[0]
    short = some.first(min(_LOSS_SAMPLES, max(2, round(_LOSS_SHARE * int(some.batch.lengths.min())))))
    y = short.measurements(first.measured)
    y[max(1, round(_LOSS_AFTER * len(y))) :] = np.nan
    values = short.parameters if first.lifting.parameters else None
    return np.asarray(short.compare(run_observers(observers, y, short.batch.inputs, values)).max(axis=-1))


def certify(observer: Observer, scales: ReliftScales, task: DesignTask) -> ReliftCertificate:
    """Certify one observer everywhere, or in an operating box where slopes have no bound of their own."""
    found = relift_certificate(observer, scales=scales)
    if found.status is ReliftStatus.UNBOUNDED:
        models = task.models
        sizes = [
            *zip(models.lifting.states, models.output_scale, strict=False),
            *zip(models.recorded_inputs, models.input_scale, strict=False),
        ]
        box = {name: (-_BOX * size, _BOX * size) for name, size in sizes}
        own = {name: (float(np.min(v)), float(np.max(v))) for name, v in models.parameters.items()}
        found = relift_certificate(observer, box, scales, own)
    if not found.certified:
        log.warning("%s: no certificate covers it as it runs. %s", observer.name, found.reason)
    return found


def save_running(folder: Path, found: Sequence[Running]) -> None:
    """Write certificates and bounds below the folder of the observers."""
    notes = {r.name: {"assumptions": r.certificate.assumptions} for r in found}
    signals = {r.name: r.signals for r in found if r.signals is not None}
    save_artifact(folder, "relift", {"certificates": notes, "signals": signals})
    for running in found:
        running.certificate.save(folder / "relift" / running.name)
