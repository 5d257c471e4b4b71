"""The verb: from uncertain models to an observer with its certificates.

uncertain models --a task for every kind of model and method--> observers
observers --on every member of the uncertain set, and as they run--> certificates --the most accurate one that is safe--> deployed
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, loader, save_artifact
from ..core.errors import ConfigError, SynthesisError
from ..core.settings import require_kind
from ..core.work import Work
from ..identify import ModelSet
from ..identify.identified import IdentifiedModels
from ..lifting import Lifting
from ..observer import EstimatorSettings, Observer, ReliftCertificate, Sensor
from ..observer.limits import Limit, Limits, limits_of
from ..observer.sensor import Sensors, require_measured
from ..observer.units import in_sizes
from ..synthesis import ObserverProblem, Synthesis
from ..uncertainty.quantify import UncertainModels
from .about import about
from .certificates import DIVERGED, Running, certify_running
from .methods.table import BY_NAME, preferred, slowest_first, suitable
from .monitor import fit_monitor, monitor_facts
from .settings import BASELINES, ObserverSettings, SynthesisSettings
from .task import DesignResult, DesignTask, is_robust, split_name
from .validation import TrainingSet

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_AS_GOOD = 1.01  # ratio of errors that is no reason to prefer one observer to another
_SURROUNDED = "worst_case_h2"  # all observers of a kind of model are certified with the disturbance model of this one, where it is designed


@dataclass(frozen=True, eq=False, repr=False)
class Design:
    """One observer with what is known about it, in the recordings' units.

    Parameters
    ----------
    name : str
        ``<kind of model>/<method>``.
    observer : Observer
    synthesis : Synthesis
    certificate : ReliftCertificate
        Of the observer as it runs, re-lifted at every step; it says itself whether it holds.
    facts : dict
        What the metrics of a study say.

    Examples
    --------
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(motors, refine=False), n_freqs=50, max_order=1)
    >>> design = kros.synthesize(uncertain, "kalman_tuned", methods=())
    >>> design.observer.lifting.states, design.synthesis.status.value, design.facts["order"]
    (('position', 'velocity', 'current'), 'optimal', 0)
    """

    name: str
    observer: Observer
    synthesis: Synthesis
    certificate: ReliftCertificate
    facts: Mapping[str, Any]

    def __repr__(self) -> str:
        percent, holds = (
            self.facts.get("hidden_error_percent"),
            "certified" if self.certificate.certified else "not certified",
        )
        error = (
            "diverges in training" if percent is None or not np.isfinite(percent) else f"training error {percent:.3g} %"
        )
        return (
            f"<Design {self.name}: {self.facts['order']} states beside the recorded ones, {error}, {holds} as it runs>"
        )

    @property
    def lower_bound(self) -> float | None:
        """No observer of this kind has a smaller worst-case norm; None where nothing is proven."""
        return self.synthesis.lower_bound if self.synthesis.worst_case_h2 is not None else None

    def save(self, folder: Path | str) -> None:
        """Write the observer, its synthesis and its certificate."""
        folder = Path(folder)
        self.observer.save(folder / "observer.json")
        self.synthesis.save(folder / "synthesis")
        self.certificate.save(folder / "certificate")
        save_artifact(folder, "design", {"name": self.name, "facts": self.facts})

    @classmethod
    @loader
    def load(cls, folder: Path) -> Design:
        """Read what `save` wrote."""
        folder = Path(folder)
        content, _ = load_artifact(folder, "design")
        synthesis, proof = Synthesis.load(folder / "synthesis"), ReliftCertificate.load(folder / "certificate")
        return cls(content["name"], Observer.load(folder / "observer.json"), synthesis, proof, content["facts"])


@dataclass(frozen=True, eq=False, repr=False)
class Designs:
    """All observers of a population."""

    designs: Mapping[str, Design]
    deployed: str
    facts: Mapping[str, dict[str, Any]]
    running: tuple[Running, ...]

    def __repr__(self) -> str:
        return f"<Designs: {', '.join(self.designs)}; deployed is {self.deployed}>"


def synthesize(
    uncertain: UncertainModels,
    method: str | None = None,
    *,
    observer: Mapping[str, Any] | None = None,
    estimator: Mapping[str, Any] | None = None,
    sensor: Mapping[str, Any] | None = None,
    limits: Mapping[str, Any] | None = None,
    robust: bool = False,
    work: Work | None = None,
    **settings: Any,
) -> Design:
    """Design an observer for a population.

    Parameters
    ----------
    uncertain : UncertainModels
        Of `kros.quantify`.
    method : str, optional
        A method such as ``worst_case_h2``, for the first kind of model that it is for, or a name such as ``koopman_edmd/mixed``. Default: all are
        tried, and the most accurate one on training episodes that is certified as it runs and tolerates dropouts is returned.
    observer, estimator : mapping, optional
        As ``[observer]`` and ``[estimator]`` of a study.
    sensor : mapping of str to mapping, optional
        What the sensors of measured states are like, as ``[sensor.<state>]`` of a study: ``{"position": {"noise": 1e-5, "delay_samples": 1}}``, see
        `kros.observer.Sensor`.
    limits : mapping of str to number, pair or False, optional
        Limits of states, as ``[limits]`` of a study: ``{"current": (-0.35, 0.35)}``, in the recordings' unit. Where a state is not named, limits that were
        found in the recordings count; False stands for none.
    robust : bool
        Whether only observers that are certified for the uncertain set are deployed, where there are any.
    work : Work, optional
        Where it runs.
    **settings
        Of `SynthesisSettings`: ``methods``, ``input_weight``, ``penalty``, ``time_limit_s``.

    Returns
    -------
    Design

    Raises
    ------
    SynthesisError
        When it cannot be made, with the reason.
    ConfigError
        When there is no such method.

    Examples
    --------
    >>> import kros
    >>> drives = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(drives, refine=False), n_freqs=50, max_order=1)
    >>> design = kros.synthesize(uncertain, "kalman_tuned", methods=())
    >>> design.name, design.observer.start([0.0]).states
    ('linear_edmd/kalman_tuned', ('position', 'velocity', 'current'))
    """
    require_kind(uncertain, UncertainModels, "Synthesize", "quantify the models first, kros.quantify(models)")
    asked = SynthesisSettings.of(settings, "Synthesize")
    among, of = (
        ObserverSettings.of(observer or {}, "Synthesize, observer"),
        EstimatorSettings.of(estimator or {}, "Synthesize, estimator"),
    )
    told = {name: Sensor.of(own, f"Synthesize, sensor.{name}") for name, own in (sensor or {}).items()}
    kept = {name: Limit.of(own, f"Synthesize, limits.{name}") for name, own in (limits or {}).items()}
    if method is None:
        found = synthesize_all(uncertain, asked, among, of, told, kept, robust=robust, work=work)
        return found.designs[found.deployed]
    name = named(uncertain, method)
    kind, short = split_name(name)
    with_set = {short, _SURROUNDED} if _SURROUNDED in asked.methods else {short}
    tasks = tasks_of(uncertain, kind, with_set, asked, of, told, kept)
    results = designed(tasks, work or Work())
    failed = {found.name: found.facts["reason"] for found in results if found.observer is None}
    if name in failed:
        raise SynthesisError(f"{name} could not be made: {failed[name]}")
    return certified(tasks, results, uncertain.models, work or Work())[0][name]


def synthesize_all(
    uncertain: UncertainModels,
    settings: SynthesisSettings | None = None,
    observer: ObserverSettings | None = None,
    estimator: EstimatorSettings | None = None,
    sensor: Sensors | None = None,
    limits: Limits | None = None,
    *,
    robust: bool = False,
    work: Work | None = None,
) -> Designs:
    """Design all observers that settings ask for, certify them, and choose the one that is deployed."""
    settings, observer, estimator, work = (
        settings or SynthesisSettings(),
        observer or ObserverSettings(),
        estimator or EstimatorSettings(),
        work or Work(),
    )
    wanted = {*observer.baselines, *settings.methods}
    tasks = [
        task
        for kind in uncertain.models.kinds
        for task in tasks_of(uncertain, kind, wanted, settings, estimator, sensor, limits)
    ]
    results = designed(tasks, work)
    for task, found in zip(tasks, results, strict=True):
        if found.observer is None and found.facts["reason"] != task.refusal:
            log.warning("%s could not be made: %s", task.name, found.facts["reason"])
    designs, running = certified(tasks, results, uncertain.models, work)
    facts = {
        found.name: dict(designs[found.name].facts) if found.name in designs else dict(found.facts) for found in results
    }
    eligible = robust_of(running, facts) if robust else running
    deployed = choose_deployed(observer.deployed, list(designs), eligible)
    designs[deployed] = watched(designs[deployed], uncertain.models, sensor, observer.false_alarm_rate, work)
    facts[deployed] = dict(designs[deployed].facts)
    return Designs(designs, deployed, facts, tuple(running))


def watched(
    design: Design, identified: IdentifiedModels, sensor: Sensors | None, rate: float, work: Work | None = None
) -> Design:
    """Return a design whose observer has a monitor, where there are enough units."""
    training = TrainingSet.whole(identified, identified.models(split_name(design.name)[0]), sensor)
    monitor = fit_monitor(design.observer, training, rate, work)
    if monitor is None:
        return design
    return replace(
        design,
        observer=replace(design.observer, monitor=monitor),
        facts={**design.facts, "monitor": monitor_facts(monitor)},
    )


def named(uncertain: UncertainModels, method: str) -> str:
    """Return the full name of an observer: that of a method for the first kind of model that it is for."""
    every = [
        f"{kind}/{m.name}" for kind in uncertain.models.kinds for m in suitable(BY_NAME, kind, uncertain.models.kinds)
    ]
    found = [name for name in every if method in (name, split_name(name)[1])]
    if not found:
        reason = "there is no such method"
        if method in get_args(BASELINES):
            reason = "it is a baseline that runs where a study evaluates, and no design"
        elif split_name(method)[1] in BY_NAME:
            reason = "it is not made for these kinds of models; lifted functions are given to kros.identify"
        raise ConfigError(f"Synthesize, method {method!r}: {reason}; known are {', '.join(every)}.")
    return found[0]


def tasks_of(
    uncertain: UncertainModels,
    kind: str,
    wanted: Iterable[str],
    settings: SynthesisSettings,
    estimator: EstimatorSettings,
    sensor: Sensors | None = None,
    limits: Limits | None = None,
) -> list[DesignTask]:
    """Return a task for every observer of one kind of model, in channels divided by their ranges."""
    from .uncertain_set import usable_problem

    identified = uncertain.models
    require_measured(sensor or {}, identified.population.measured)
    recorded, own = identified.models(kind), uncertain.sets[kind]
    training, whole = (
        of(identified, recorded, sensor).normalised(recorded) for of in (TrainingSet.of, TrainingSet.whole)
    )
    models = recorded.normalised()
    noise = measurement_noise(identified, recorded, sensor or {}) / recorded.output_scale[list(recorded.measured)]
    problem, refusal = usable_problem(models, own, noise, settings)
    shared: dict[str, Any] = {
        "models": models,
        "unit": uncertain.nominal,
        "problem": problem,
        "refusal": refusal,
        "noise": noise,
    }
    shared |= {"training": training, "recordings": whole, "covered": own.unit_ids}
    shared |= {
        "max_order": uncertain.max_order,
        "pooled": uncertain.pooled,
        "settings": settings,
        "estimator": estimator,
    }
    if own_limits := limits_of(limits or {}, identified.facts.limits, identified.population.states):
        shared["limits"] = {name: limit.in_unit(recorded.sizes[name]) for name, limit in own_limits.items()}
    methods = suitable(wanted, kind, identified.kinds)
    return [DesignTask(f"{kind}/{method.name}", method.name, **shared) for method in methods]


def measurement_noise(identified: IdentifiedModels, models: ModelSet, sensor: Sensors) -> Array:
    """Return the standard deviation of every measurement's noise."""
    names, steps = [models.lifting.states[i] for i in models.measured], np.zeros(len(models.measured))
    if any(own.jitter_samples for own in sensor.values()):
        steps = TrainingSet.of(identified, models).read().steps(models.measured)
    told = [sensor.get(name, Sensor()) for name in names]
    found = [
        max(own.resolution or 0.0, identified.facts.resolution[name]) for name, own in zip(names, told, strict=True)
    ]
    return np.sqrt(
        [own.model_copy(update={"resolution": r}).variance(s) for own, r, s in zip(told, found, steps, strict=True)]
    )


def designed(tasks: list[DesignTask], work: Work) -> list[DesignResult]:
    """Design the observers of all tasks; those that take longest start first, so that no worker waits for them in the end."""
    from .methods.design import design  # Riccati equations and solvers are there when something is designed

    order = slowest_first([task.method for task in tasks])
    made = dict(zip(order, work.map("synthesize", design, [tasks[i] for i in order]), strict=True))
    return [made[i] for i in range(len(tasks))]


def certified(
    tasks: list[DesignTask], results: list[DesignResult], identified: IdentifiedModels, work: Work
) -> tuple[dict[str, Design], list[Running]]:
    """Certify the observers that were made: on every member of the uncertain set, and as they run."""
    from .uncertain_set import certificate

    pairs = [(task, found) for task, found in zip(tasks, results, strict=True) if found.observer is not None]
    on_the_set = [partial(certificate, task, found, certified_problem(task, pairs)) for task, found in pairs]
    side_by_side: dict[tuple[str, Lifting], list[tuple[DesignTask, DesignResult]]] = {}
    for task, found in pairs:
        assert found.observer is not None
        side_by_side.setdefault((task.models.name, found.observer.lifting), []).append((task, found))
    as_they_run = [partial(certify_running, own[0][0], [found for _, found in own]) for own in side_by_side.values()]
    found_of: list[Any] = work.run("certify", [*as_they_run, *on_the_set])  # the first ones take longest
    by_name = {one.name: one for of_lifting in found_of[: len(as_they_run)] for one in of_lifting}
    running = [by_name[found.name] for _, found in pairs]
    designs = {}
    for (task, found), holds in zip(pairs, found_of[len(as_they_run) :], strict=True):
        assert found.observer is not None
        assert found.synthesis is not None
        one, facts = by_name[found.name], {**found.facts, **holds, **by_name[found.name].facts()}
        observer = in_sizes(replace(found.observer, guard=by_name[found.name].guard), {})
        observer = replace(observer, about=about(task, identified, observer, one.certificate, facts))
        synthesis = replace(found.synthesis, controller=observer.controller)
        designs[found.name] = Design(found.name, observer, synthesis, one.certificate, facts)
    return designs, running


def certified_problem(task: DesignTask, pairs: Sequence[tuple[DesignTask, DesignResult]]) -> ObserverProblem | None:
    """Return the set that all observers of a kind of model are certified for: that of its worst-case synthesis, where there is one."""
    for other, found in pairs:
        if other.models.name == task.models.name and other.method == _SURROUNDED:
            return found.problem
    return task.problem


def choose_deployed(wanted: str | None, made: list[str], running: Sequence[Running]) -> str:
    """Return the observer that is deployed: the one asked for, else the most accurate one with all certificates that tolerates dropouts."""
    if wanted is not None:
        if wanted not in made:
            raise SynthesisError(
                f"observer.deployed = {wanted!r}: there is no such observer, only {', '.join(made)}; name one of them."
            )
        return wanted
    bounded = [r for r in running if r.certificate.certified and np.isfinite(r.hidden_percent)]
    safe = [r for r in bounded if r.certified] or bounded
    candidates = [r for r in safe if r.dropout_percent < DIVERGED] or safe
    least = min((r.hidden_percent for r in candidates), default=np.inf)
    best = preferred([r.name for r in candidates if r.hidden_percent <= _AS_GOOD * least] or made)
    if best is None:
        raise SynthesisError("No observer could be made; see the reasons above.")
    return best


def robust_of(running: Sequence[Running], facts: Mapping[str, Mapping[str, Any]]) -> Sequence[Running]:
    """Return the observers that are certified for the uncertain set; all where none is."""
    return [r for r in running if is_robust(facts[r.name])] or running
