"""Certificates of observers for the uncertain set and as nonlinear systems, with errors and guards from training."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..core import TINY, Array, Record, StateSpace, SynthesisError, frozen, gain, grouped
from ..data import EpisodeBatch
from ..evaluate.errors import error_rms
from ..identify.free_run import recursion
from ..observer import Observer, ReliftScales, Screen, factors, one_step_residual
from ..observer.certificate.certificate import ReliftCertificate, ReliftStatus, relift_certificate
from ..observer.certificate.signals import SignalBound, signal_bound
from ..observer.estimator.certificate import filter_certificate, left_out_bound, linear_estimate
from ..observer.estimator.gaps import losses
from ..observer.runtime import Guard
from ..observer.simulate import run_observer, run_observers
from ..synthesis import ObserverProblem
from ..synthesis.worst_case.certificate import certify_errors
from .monitor import settling
from .task import Design, DesignTask
from .training import TRAINING, hidden_mean, percent_of

log = logging.getLogger(__name__)


@frozen
class CertificateSettings:
    """On how much of the recordings certificates and guards rest."""

    samples: int = 5_000  # of an episode, at most
    losses: int = 12  # patterns of lost measurements that are simulated; in the first one they stop
    box: float = 1.5  # operating box around the recordings, in their ranges, where slopes have no global bounds
    room: float = 1.0  # by which estimates may leave what they and the recordings were in training, in ranges
    largest: float = 2.0  # most that an estimate may be where measurements are lost, of the largest value in training


DEFAULT = CertificateSettings()
Parts = tuple[Guard | None, ReliftCertificate, SignalBound]


def certify(task: DesignTask, designs: Sequence[Design]) -> list[tuple[Guard | None, ReliftCertificate, Record]]:
    """Return guards, certificates and facts of observers of one lifting, certificates in the recordings' units."""
    batches, observers = certified_on(task), [design.observer for design in designs]
    parts = (
        _model_parts(observers, batches, task)
        if observers[0].bank is None
        else [_filter_parts(design, batches[0], task) for design in designs]
    )
    growth = [design.facts.get("left_out_to_training", {}) for design in designs]
    by = np.array([[of.get(name, 1.0) for name in observers[0].recorded] for of in growth])
    errors = hidden_error_percent(observers, batches, by), loss_error_percent(observers, batches[0])
    return [
        (guard, proof, _facts(proof, bound, observer, percents))
        for observer, (guard, proof, bound), *percents in zip(
            observers, parts, *map(np.ndarray.tolist, errors), strict=True
        )
    ]


def certified_on(task: DesignTask) -> list[EpisodeBatch]:
    """Return the starts of the first episodes of units, all of short ones, and the same of other conditions."""
    home, units = ({getattr(k, name) for k in task.training.keys} for name in ("condition", "unit"))
    elsewhere = (k for k in task.recordings.keys if k.condition not in home and k.unit in units)
    others = grouped(elsewhere, lambda key: key.condition)
    batches = []
    for training in (task.training, *(replace(task.recordings, keys=tuple(keys)) for keys in others.values())):
        firsts = tuple(keys[0] for keys in grouped(training.keys, lambda key: key.unit).values())
        first = replace(training, keys=firsts).read().head(DEFAULT.samples)
        batches.append(first if len(first.states) > TRAINING.short else training.read())
    return batches


def _model_parts(observers: Sequence[Observer], batches: Sequence[EpisodeBatch], task: DesignTask) -> Iterator[Parts]:
    """Yield guards, certificates and bounds of corrected models, which run side by side."""
    first, sizes = observers[0], task.models.output_scale[: len(observers[0].recorded)]
    recorded = batches[0].states, batches[0].inputs, first.own(batches[0].parameters)
    for observer, guard in zip(observers, guards_of(observers, batches), strict=True):
        residual = one_step_residual(first.lifting, observer.A, observer.B, *recorded)
        certificate = certify_model(observer, ReliftScales.typical(sizes, residual, task.noise), task, batches)
        bound = signal_bound(certificate, observer, batches[0])
        yield guard, certificate.in_units(observer), bound


def _filter_parts(design: Design, batch: EpisodeBatch, task: DesignTask) -> Parts:
    """Return guard, certificate and bound of a filter bank."""
    observer = design.observer
    n, at = len(observer.recorded), list(observer.measured)
    estimates = run_observer(observer, batch.measurements(at), batch.inputs, observer.own(batch.parameters))
    square = error_rms(estimates, batch.states, batch.lengths) ** 2
    units = grouped(range(len(square)), batch.units.__getitem__)
    errors = np.sqrt([square[rows].mean(axis=0) for rows in units.values()])
    sizes, by = task.models.output_scale[:n], factors(observer, {})[0]
    scales = ReliftScales(sizes, np.sqrt(n * square.mean(axis=0)), task.noise * np.sqrt(len(at)))
    recorded = ReliftScales(scales.error * by[:n], scales.residual * by[:n], scales.noise * by[at])
    bound = left_out_bound(observer, sizes, list(units), errors, design.facts["left_out_worst_percent"])
    return observer.guard, replace(filter_certificate(observer, scales), scales=recorded), bound


def _facts(certificate: ReliftCertificate, bound: SignalBound, observer: Observer, errors: Sequence[float]) -> Record:
    """Return what the metrics say of certificates, and of errors in training, where measurements are lost too."""
    recorded = bound.cover * factors(observer, {})[0][: len(bound.states)]
    facts: Record = {
        "relift_certified": certificate.certified,
        "relift_gain": certificate.gain,
        "hidden_error_percent": errors[0],
        "loss_error_percent": errors[1],
        **bound.facts(),
        "assumptions": certificate.assumptions,
        "set_bound": dict(zip(bound.states, recorded.tolist(), strict=True)),
    }
    return facts if certificate.certified else facts | {"relift_reason": certificate.reason}


def hidden_error_percent(observers: Sequence[Observer], batches: Sequence[EpisodeBatch], by: Array) -> Array:
    """Return the typical error of hidden states over conditions, (observer,), errors times factors, (observer, n)."""
    measured = observers[0].measured
    logs = [np.log(hidden_mean(percent_of(observers, batch) * by, measured)) for batch in batches]
    return np.exp(np.mean(logs, axis=0))


def loss_error_percent(observers: Sequence[Observer], batch: EpisodeBatch) -> Array:
    """Return the largest error in percent of the largest value where measurements are lost, shape (observer,).

    Episodes have patterns of losses by how far they move, so that names and the order of units do not matter.
    """
    size, first = np.maximum(np.abs(batch.states).max(axis=(0, 1)), TINY), observers[0]
    moved = (batch.states.std(axis=0, where=batch.inside[..., None]) / size).sum(axis=-1)
    rows = np.argsort(moved)[np.linspace(0, len(moved) - 1, DEFAULT.losses).round().astype(int)]
    some = batch.take(rows.tolist()).head(int(batch.lengths[rows].min()))
    y, x = some.measurements(first.measured), some.states
    lost = losses(np.random.default_rng(0), len(y), len(rows))
    lost[len(y) // 4 :, 0] = True
    estimates = run_observers(observers, np.where(lost[..., None], np.nan, y), some.inputs, first.own(some.parameters))
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.array([(np.abs(e[..., : x.shape[-1]] - x).max(axis=(0, 1)) / size).max() for e in estimates])
    return np.where(np.isfinite(errors), 100 * errors, np.inf)


def certify_model(
    observer: Observer, scales: ReliftScales, task: DesignTask, batches: Sequence[EpisodeBatch]
) -> ReliftCertificate:
    """Certify one observer everywhere, or where slopes have no global bound in an operating box around recordings."""
    certificate, models = relift_certificate(observer, scales=scales), task.models
    if certificate.status is ReliftStatus.UNBOUNDED:
        signals = np.concatenate([np.concatenate([b.states, b.inputs], axis=-1)[b.inside] for b in batches])
        low, high = signals.min(axis=0), signals.max(axis=0)
        room = (DEFAULT.box - 1) * (high - low) / 2
        ends = zip((low - room).tolist(), (high + room).tolist(), strict=True)
        box = dict(zip((*observer.recorded, *models.recorded_inputs), ends, strict=True))
        values = {name: (float(np.min(v)), float(np.max(v))) for name, v in models.parameters.items()}
        certificate = relift_certificate(observer, box, scales, values)
    if not certificate.certified:
        log.warning("%s: no certificate for the nonlinear observer. %s", observer.name, certificate.reason)
    return certificate


def guards_of(observers: Sequence[Observer], batches: Sequence[EpisodeBatch]) -> list[Guard | None]:
    """Return guards: bounds of all states from estimates and recordings in training, from the first sample and amid."""
    extents = [_extents(observers, batch, first) for batch in batches for first in (0, len(batch.states) // 2)]
    low, high, size, corrections = zip(*extents, strict=True)
    least, most, largest = np.min(low, axis=0), np.max(high, axis=0), DEFAULT.largest * np.max(size, axis=0)
    room = DEFAULT.room * np.maximum(most - least, TINY)
    least = np.maximum(least - room, np.minimum(least, -largest))
    most = np.minimum(most + room, np.maximum(most, largest))
    of_corrections = [np.max(one, axis=0) for one in zip(*corrections, strict=True)]
    return [_guard(*one) for one in zip(observers, least, most, of_corrections, strict=True)]


def _extents(observers: Sequence[Observer], batch: EpisodeBatch, first: int) -> tuple[Array, Array, Array, list[Array]]:
    """Return bounds of estimates and recordings (observer, n), sizes of recordings (n,), and largest corrections."""
    q = list(observers[0].measured)
    y, states, inputs = batch.measurements(q)[first:], batch.states[first:], batch.inputs[first:]
    inside = (np.arange(first, first + len(y))[:, None] < batch.lengths)[..., None]
    x = np.stack([*run_observers(observers, y, inputs, observers[0].own(batch.parameters))])
    least = states.min(axis=(0, 1), where=inside, initial=np.inf)
    most = states.max(axis=(0, 1), where=inside, initial=-np.inf)
    low = np.minimum(x.min(axis=(1, 2), where=inside, initial=np.inf), least)
    high = np.maximum(x.max(axis=(1, 2), where=inside, initial=-np.inf), most)
    corrections = []
    for o, estimate in zip(observers, x, strict=True):
        nu = np.where(inside & np.isfinite(y), y - estimate[..., q], 0.0)
        states_c = recursion(o.controller.A, o.controller.B, np.zeros((nu.shape[1], o.controller.n_states)), nu)
        corrections.append(np.abs(states_c).max(axis=(0, 1), initial=0.0))
    return low, high, np.maximum(np.abs(least), np.abs(most)), corrections


def _guard(observer: Observer, low: Array, high: Array, correction: Array) -> Guard | None:
    """Return the guard of one observer, None where it diverges; estimates may be what measurements may be."""
    if not all(np.isfinite(side).all() for side in (low, high, correction)):
        return None
    at, q, screen = list(observer.measured), len(observer.measured), Screen.of(observer)
    low[at], high[at] = np.minimum(low[at], screen.least[:q]), np.maximum(high[at], screen.most[:q])
    correction = (1 + 2 * DEFAULT.room) * np.maximum(correction, TINY)
    return Guard(low, high, correction, settling(observer))


def certificate(task: DesignTask, design: Design) -> Record:
    """Return what holds for an observer on every member of the set."""
    observer = design.observer
    facts: Record = {
        "order": observer.controller.n_states + observer.internal,
        "spectral_radius_max": None,
        "worst_case_h2": None,
    }
    if design.facts.get("rows_fitted_to_single_steps"):
        reason = "the observer runs rows fitted to single steps, not the nominal model that the uncertain set surrounds"
        return facts | {"reason": reason}
    if task.problem is None:
        return facts | {"reason": task.refusal}
    problem = replace(task.problem, injection=design.synthesis.injection)
    try:
        errors, mean = error_maps(task, design, problem)
        facts["spectral_radius_max"] = float(max(errors.spectral_radius(), task.models.spectral_radius().max()))
        bound = certify_errors(problem, errors, mean)
        if observer.bank is not None:
            facts["constant_h2"] = float(np.linalg.norm(mean))
            require_useful(problem, observer, bound)
        return facts | {"worst_case_h2": bound}
    except SynthesisError as error:
        log.warning("%s: no certificate for the set of plants: %s", task.name, error)
        return facts | {"reason": str(error)}


def require_useful(problem: ObserverProblem, observer: Observer, bound: float) -> None:
    """Refuse a bound that is no better than without an estimate: models relate states less closely than machines."""
    rows, dt = problem.nominal.n_outputs, problem.nominal.dt
    nothing = gain(np.zeros((rows, len(observer.measured) + rows + problem.nominal.n_inputs)), dt)
    without = certify_errors(problem, problem.estimate_error(nothing))
    if bound >= without:
        raise SynthesisError(
            f"the bound over the set is {bound:.3g}, without an estimate {without:.3g}: machines relate states more "
            "closely than models do."
        )


def error_maps(task: DesignTask, design: Design, problem: ObserverProblem) -> tuple[StateSpace, Array]:
    """Return the system from what drives plants of the set to the weighted error of an observer, and the mean error."""
    if design.observer.bank is None:
        return problem.error_system(design.synthesis.controller), np.zeros(1)
    estimate, mean = linear_estimate(design.observer, task.models.lifting)
    return problem.estimate_error(estimate), problem.scaled[3] @ (mean / problem.output_scale)
