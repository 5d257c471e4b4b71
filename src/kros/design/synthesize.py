"""The verb: from uncertain models to an observer with its certificates.

uncertain models --a task for every kind of model and method--> designs
designs --on every member of the uncertain set, and as nonlinear observers--> certificates
certified designs --the most accurate one--> deployed, with a monitor
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import version
from itertools import chain
from typing import Any

import numpy as np

from ..core import Array, ByName, ConfigError, Record, SynthesisError, Work, frozen, grouped, plain, require_kind
from ..data import scaling_of
from ..identify import IdentifiedModels, ModelSet
from ..observer import EstimatorSettings, Sensor, Sensors, require_measured
from ..observer.units import in_sizes
from ..synthesis import ObserverProblem
from ..uncertainty import UncertainModel, UncertainModels
from .certificates import certificate, certify
from .methods import METHODS, methods_of, preferred, suitable
from .monitor import fit_monitor
from .settings import ObserverSettings, SynthesisSettings
from .task import Design, DesignTask, Method, split_name
from .training import TrainingSet

log = logging.getLogger(__name__)


@frozen
class DeploymentSettings:
    """Which observer is deployed."""

    as_good: float = 1.01  # ratio of errors that is no reason to prefer one observer to another
    diverged: float = 300.0  # percent of the largest value, of the largest error where measurements are lost


DEPLOYMENT = DeploymentSettings()


@frozen
class Designs:
    """All observers of a population."""

    designs: Mapping[str, Design]
    deployed: str
    facts: Mapping[str, ByName]  # what the metrics say of every observer, designed or not


def synthesize(
    uncertain: UncertainModels,
    method: str | Method | None = None,
    *,
    observer: ByName | None = None,
    estimator: ByName | None = None,
    sensor: ByName | None = None,
    work: Work | None = None,
    **settings: Any,
) -> Design:
    """Design an observer for a population.

    Parameters
    ----------
    uncertain : UncertainModels
        Of `kros.quantify`.
    method : str or Method, optional
        A method such as ``worst_case_h2``, for the first kind of model that it is for, or a name such as
        ``linear/worst_case_h2``, or a method of `kros.design.methods` with other options. Default: all are tried, and
        the most accurate one on training episodes that is certified and tolerates dropouts is returned.
    observer, estimator : mapping, optional
        As ``[observer]`` and ``[estimator]`` of a study.
    sensor : mapping of str to mapping, optional
        What the sensors of measured states are like, as ``[sensor.<state>]`` of a study: ``{"position": {"noise": 1e-5,
        "delay_samples": 1}}``, see `kros.observer.Sensor`.
    work : Work, optional
        Where it runs.
    **settings
        Of `SynthesisSettings`: ``methods``.

    Returns
    -------
    Design

    Raises
    ------
    SynthesisError
        When it cannot be designed, with the reason.
    ConfigError
        When there is no such method.

    Examples
    --------
    >>> import kros
    >>> drives = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(drives, refine=False), n_freqs=50)
    >>> design = kros.synthesize(uncertain, "kalman_tuned", methods=())
    >>> design.name, design.observer.start([0.0]).states
    ('linear_edmd/kalman_tuned', ('position', 'velocity', 'current'))
    """
    require_kind(uncertain, UncertainModels, "Synthesize", "quantify the models first, kros.quantify(models)")
    options = SynthesisSettings.of(settings, "Synthesize")
    compared = ObserverSettings.of(observer or {}, "Synthesize, observer")
    regression = EstimatorSettings.of(estimator or {}, "Synthesize, estimator")
    sensors = {name: Sensor.of(one, f"Synthesize, sensor.{name}") for name, one in (sensor or {}).items()}
    work = work or Work()
    if method is None:
        every = synthesize_all(uncertain, options, compared, regression, sensors, work)
        return every.designs[every.deployed]
    kind, chosen = _named(uncertain, method, regression)
    tasks = tasks_of(uncertain, kind, [chosen], sensors)
    designs, failed = _designed(tasks, work)
    name = f"{kind}/{chosen.name}"
    if name in failed:
        raise SynthesisError(f"{name} could not be designed: {failed[name]}")
    return certified(tasks, designs, uncertain.models, work)[name]


def synthesize_all(
    uncertain: UncertainModels,
    settings: SynthesisSettings,
    observer: ObserverSettings,
    estimator: EstimatorSettings,
    sensor: Sensors,
    work: Work,
) -> Designs:
    """Design all observers that settings ask for, certify them, and choose the one that is deployed."""
    methods = methods_of((*observer.baselines, *settings.methods), estimator)
    tasks = [task for kind in uncertain.models.kinds for task in tasks_of(uncertain, kind, methods, sensor)]
    designs, failed = _designed(tasks, work)
    for task in tasks:
        if failed.get(task.name, task.refusal) != task.refusal:
            log.warning("%s could not be designed: %s", task.name, failed[task.name])
    designs = certified(tasks, designs, uncertain.models, work)
    deployed = choose_deployed(list(designs.values()))
    design, models = designs[deployed], uncertain.models.models(split_name(deployed)[0])
    monitor = fit_monitor(design.observer, TrainingSet.whole(uncertain.models, models, sensor), work=work)
    if monitor is not None:
        known = {"false_alarm_rate": monitor.false_alarm_rate, "units": monitor.units, "settle_samples": monitor.settle}
        facts = {**design.facts, "monitor": known}
        designs[deployed] = replace(design, observer=replace(design.observer, monitor=monitor), facts=facts)
    reasons: dict[str, ByName] = {name: {"status": "failed", "reason": reason} for name, reason in failed.items()}
    return Designs(designs, deployed, {t.name: reasons.get(t.name) or designs[t.name].facts for t in tasks})


def _named(uncertain: UncertainModels, method: str | Method, estimator: EstimatorSettings) -> tuple[str, Method]:
    """Return a method and the kind of model that it is named with, or the first one that it is for."""
    methods = methods_of([m.name for m in METHODS], estimator) + ([] if isinstance(method, str) else [method])
    pairs = [(kind, m) for kind in uncertain.models.kinds for m in suitable(methods, kind)]
    for kind, m in pairs:
        if method in (m, m.name, f"{kind}/{m.name}"):
            return kind, m
    known = ", ".join(f"{kind}/{m.name}" for kind, m in pairs)
    raise ConfigError(f"Synthesize: there is no method {method!r} for these models; known are {known}.")


def tasks_of(
    uncertain: UncertainModels, kind: str, methods: Iterable[Method], sensor: Sensors | None = None
) -> list[DesignTask]:
    """Return a task for every observer of one kind of model."""
    identified, covered = uncertain.models, uncertain.sets[kind]
    require_measured(sensor or {}, identified.population.measured)
    recorded = identified.models(kind)
    models = recorded.normalised()
    noise = measurement_noise(identified, recorded, sensor or {}) / recorded.output_scale[list(recorded.measured)]
    problem, refusal = usable_problem(models, covered, noise)
    task = partial(
        DesignTask,
        models=models,
        unit=uncertain.nominal,
        problem=problem,
        refusal=refusal,
        noise=noise,
        training=TrainingSet.of(identified, recorded, sensor).normalised(recorded),
        recordings=TrainingSet.whole(identified, recorded, sensor).normalised(recorded),
        covered=covered.unit_ids,
    )
    return [task(f"{kind}/{m.name}", m) for m in suitable(methods, kind)]


def usable_problem(models: ModelSet, uncertain: UncertainModel, noise: Array) -> tuple[ObserverProblem | None, str]:
    """Return the synthesis problem of one kind of model, or None and why there is none."""
    try:
        problem = ObserverProblem.from_uncertain(models, uncertain, noise)
        problem.require_sound()
        return problem, ""
    except SynthesisError as error:
        log.warning("%s: no robust observers and no certificates for the set of plants: %s", models.name, error)
        return None, str(error)


def measurement_noise(identified: IdentifiedModels, models: ModelSet, sensor: Sensors) -> Array:
    """Return the standard deviation of every measurement's noise."""
    names, steps = [models.lifting.states[i] for i in models.measured], np.zeros(len(models.measured))
    if any(one.jitter_samples for one in sensor.values()):
        states = TrainingSet.of(identified, models).read().states[..., list(models.measured)]
        steps = np.sqrt(np.mean(np.diff(states, axis=0) ** 2, axis=(0, 1)))
    sensors = (sensor.get(name, Sensor()).no_finer_than(identified.facts.resolution[name]) for name in names)
    return np.sqrt([one.variance(step) for one, step in zip(sensors, steps, strict=True)])


def _designed(tasks: Sequence[DesignTask], work: Work) -> tuple[dict[str, Design], dict[str, str]]:
    """Return designs, and reasons of those that failed; the last methods start first, since they take longest."""
    places = {method.name: place for place, method in enumerate(METHODS)}
    order = sorted(tasks, key=lambda task: -places.get(task.method.name, len(places)))
    results = dict(zip((task.name for task in order), work.map("synthesize", _design, order), strict=True))
    results = {task.name: results[task.name] for task in tasks}
    designs = {name: result for name, result in results.items() if isinstance(result, Design)}
    return designs, {name: result for name, result in results.items() if isinstance(result, str)}


def _design(task: DesignTask) -> Design | str:
    """Design one observer, or return why there is none."""
    try:
        return task.method.design(task)
    except SynthesisError as error:
        return str(error)


def certified(
    tasks: Sequence[DesignTask], designs: Mapping[str, Design], identified: IdentifiedModels, work: Work
) -> dict[str, Design]:
    """Certify observers as nonlinear ones, a lifting side by side, and on the set."""
    pairs = [(task, designs[task.name]) for task in tasks if task.name in designs]
    groups = grouped(pairs, lambda pair: (pair[0].models.name, pair[1].observer.lifting))
    nonlinear = [partial(certify, group[0][0], [design for _, design in group]) for group in groups.values()]
    linear = [partial(certificate, task, design) for task, design in pairs]
    results: list[Any] = work.run("certify", [*nonlinear, *linear])  # the first ones take longest
    names = (task.name for task, _ in chain(*groups.values()))
    parts, final = dict(zip(names, chain(*results[: len(nonlinear)]), strict=True)), {}
    for (task, design), of_set in zip(pairs, results[len(nonlinear) :], strict=True):
        guard, proof, known = parts[task.name]
        observer = in_sizes(replace(design.observer, guard=guard), {})  # in the recordings' units
        solved = replace(design.synthesis, controller=observer.controller)
        design = Design(design.name, observer, solved, {**design.facts, **known, **of_set}, proof)
        final[task.name] = replace(design, observer=replace(observer, about=about(task, identified, design)))
    return final


def choose_deployed(designs: Sequence[Design]) -> str:
    """Return the most accurate observer with all certificates that tolerates dropouts."""
    errors = {d.name: float(d.facts["hidden_error_percent"]) for d in designs}
    bounded = [d for d in designs if d.certificate and d.certificate.certified and np.isfinite(errors[d.name])]
    safe = [d for d in bounded if d.certified] or bounded
    candidates = [d for d in safe if d.facts["loss_error_percent"] < DEPLOYMENT.diverged] or safe
    least = min((errors[d.name] for d in candidates), default=np.inf)
    good = [d.name for d in candidates if errors[d.name] <= DEPLOYMENT.as_good * least]
    best = preferred(good or [d.name for d in designs])
    if best is None:
        raise SynthesisError("No observer could be designed; see the reasons above.")
    return best


def about(task: DesignTask, identified: IdentifiedModels, design: Design) -> Record:
    """Return the object ``about`` of an observer's file, in the recordings' units."""
    population, known, calibration = identified.population, identified.facts, identified.calibration
    observer, certificate, facts = design.observer, design.certificate, design.facts
    assert certificate is not None
    proof = {name: getattr(certificate, name) for name in ("certified", "reason", "gain", "assumptions")}
    channels = (*population.states, *population.inputs)
    content: Record = {
        "kros": version("kros"),
        "units_of_measure": {c.name: c.unit for c in population.channels if c.name in identified.sizes},
        "largest_in_training": identified.sizes,
        "columns": {name: asdict(scaling_of(population.scaling, name)) for name in channels},
        "sensor": {
            name: observer.sensor.get(name, Sensor()).no_finer_than(known.resolution[name]).model_dump()
            for name in population.measured
        },
        "trained_on": {
            "units": len(set(known.pooled) & set(task.models.unit_ids)),
            "conditions": identified.conditions,
            "identify_on": known.identify_on,
        },
        "as_it_runs": {**proof, "operating_box": certificate.box},
        "uncertain_set": {"worst_case_h2": facts.get("worst_case_h2"), "reason": facts.get("reason") or ""},
    }
    if calibration is not None and calibration.spec.parameter in observer.lifting.parameters:
        values = {name: getattr(calibration.spec, name) for name in ("angle", "ratio", "reference", "measured")}
        content["parameters"] = {calibration.spec.parameter: {**values, "lag_rad": calibration.lag_rad}}
    parts = ("certified", "reason", "bound_percent", "outside")
    signals = {name: facts[f"set_{name}"] for name in parts if f"set_{name}" in facts}
    if signals:
        content["recorded_signals"] = signals
    return dict(plain(content))
