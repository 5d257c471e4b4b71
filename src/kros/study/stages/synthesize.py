"""Stage: synthesise robust observers and the baselines they are compared with, and certify every one for the same set."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import load_artifact, save_artifact
from ...core.errors import SynthesisError
from ...data.population import EpisodeKey
from ...data.scaled import scale_population
from ...design.certificates import LOST, Running, certify_running, save_running
from ...design.methods import preferred, slowest_first, suitable
from ...design.residual_shaped import OwnModel
from ...design.task import Product, Task, produce
from ...design.validation import TUNING_EPISODES, TUNING_UNITS, TuningSet
from ...identify import ModelSet
from ...observer import Observer, in_sizes
from ...synthesis import Injection, ObserverProblem, Synthesis, check_units
from ...synthesis.worst_case.certificate import certify
from ...uncertainty import Structure, UncertainModel
from ..engine.context import Context
from . import calibrate

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_AS_GOOD = 1.01  # ratio of errors that is no reason to prefer one observer to another
WORST_CASE = ("worst_case_h2", "worst_case_hinf")


def run(context: Context) -> None:
    """Make all observers, certify them, save them."""
    tasks = [task for name in context.identified.kinds for task in tasks_of(context, name)]
    products = produced(context, tasks)
    facts = {}
    certificates = iter(context.work.run("certify", certificates_of(tasks, products)))
    for task, product in zip(tasks, products, strict=True):
        facts[task.name] = dict(product.facts)
        if product.synthesis is None:
            if product.facts["reason"] != task.refusal:
                log.warning("%s could not be made: %s", task.name, product.facts["reason"])
        else:
            facts[task.name] |= next(certificates)
            save(context, task, product.synthesis)
    made = [p.name for p in products if p.synthesis is not None]
    folder = context.store.draft("observers")
    running = [r for found in context.work.run("certify as it runs", as_it_runs(tasks, products)) for r in found]
    save_running(folder, running)
    eligible = robust_of(running, facts) if context.config.require.robust else running
    deployed = choose_deployed(context.config.observer.deployed, made, eligible)
    for found in running:
        facts[found.name] |= found.facts()
    save_artifact(folder, "observers", {"names": made, "deployed": deployed, "facts": facts})
    Observer.load(folder / f"{deployed}.json").save(folder / "deployed.json")


def produced(context: Context, tasks: list[Task]) -> list[Product]:
    """Make the observers of all tasks; those that take longest start first, so that no worker waits for them in the end."""
    order = slowest_first([task.method for task in tasks])
    made = dict(zip(order, context.work.map("synthesize", produce, [tasks[i] for i in order]), strict=True))
    return [made[i] for i in range(len(tasks))]


def certificates_of(tasks: list[Task], products: list[Product]) -> list[Callable[[], dict[str, Any]]]:
    """Return the work of certifying every observer that was made for the uncertain set."""
    return [
        partial(certificate, task, product.synthesis, certified_problem(task, tasks, products))
        for task, product in zip(tasks, products, strict=True)
        if product.synthesis is not None
    ]


def as_it_runs(tasks: list[Task], products: list[Product]) -> list[Callable[[], list[Running]]]:
    """Return the work of certifying all observers as they run, one piece for every kind of model."""
    pairs = list(zip(tasks, products, strict=True))
    kinds = [[pair for pair in pairs if pair[0].models.name == name] for name in dict.fromkeys(task.models.name for task in tasks)]
    return [partial(certify_running, [t for t, _ in kind], [p for _, p in kind]) for kind in kinds]


def choose_deployed(wanted: str | None, made: list[str], running: Sequence[Running]) -> str:
    """Return the observer that is handed over: the one asked for, else the most accurate one that is certified as it runs and bears gaps.

    Accuracy is that on training episodes, of the states that are not measured. Where no observer bears missing measurements, those that are certified
    compete; where there is none either, the best guarantee of the best model decides.
    """
    if wanted is not None:
        if wanted not in made:
            raise SynthesisError(f"observer.deployed = {wanted!r}: there is no such observer, only {', '.join(made)}; name one of them.")
        return wanted
    certified = [r for r in running if r.certificate.certified and np.isfinite(r.hidden_percent)]
    candidates = [r for r in certified if r.blind_percent < LOST] or certified
    least = min((r.hidden_percent for r in candidates), default=np.inf)
    best = preferred([r.name for r in candidates if r.hidden_percent <= _AS_GOOD * least] or made)
    if best is None:
        raise SynthesisError("No observer could be made; see the reasons above.")
    return best


def robust_of(running: Sequence[Running], facts: Mapping[str, Mapping[str, Any]]) -> Sequence[Running]:
    """Return the observers that are certified for the uncertain set, for a study that requires it; all where none is."""
    return [r for r in running if facts[r.name].get("worst_case_h2") is not None] or running


def tasks_of(context: Context, name: str) -> list[Task]:
    """Return a task for every observer of one kind of model, in channels divided by their ranges."""
    recorded, config = context.identified.models(name), context.config
    models = recorded.normalised()
    unit = load_artifact(context.store.path("uncertainty"), "choice")[0]["nominal"]
    folder = context.store.path("uncertainty", name)
    noise = measurement_noise(context, recorded) / recorded.output_scale[list(recorded.measured)]
    tuning = tuning_set(context, models)
    outputs, inputs = recorded.output_scale[list(recorded.measured)], recorded.input_scale[: len(recorded.recorded_inputs)]
    seen = tuning.seen.times(1 / outputs, 1 / inputs) if tuning.seen is not None else None
    tuning = replace(tuning, population=scale_population(tuning.population, recorded.sizes), seen=seen)
    uncertain = UncertainModel.load(folder)
    problem, refusal = usable_problem(models, unit, uncertain, noise, context)
    methods = suitable(config.observer.baselines + config.synthesis.methods, name, refined=name not in context.identified.edmd_kinds)
    settings: dict[str, Any] = {"input_weight": config.synthesis.input_weight, "time_limit_s": config.synthesis.time_limit_s}
    settings |= {"max_order": config.uncertainty.max_order, "max_states": config.synthesis.max_states, "covered": uncertain.unit_ids}
    settings |= {"memory": config.predictor, "tune": config.synthesis.tune}
    return [Task(f"{name}/{method.name}", method.name, models, unit, problem, refusal, noise, tuning, **settings) for method in methods]


def usable_problem(
    models: ModelSet, unit: str, uncertain: UncertainModel, noise: Array, context: Context
) -> tuple[ObserverProblem | None, str]:
    """Return the synthesis problem of one kind of model, or None and why there is none."""
    if uncertain.weight.structure is Structure.ENTRYWISE:
        refusal = (
            "the weights are entrywise, made for a diagonal perturbation, and synthesis is for a full one; "
            "set uncertainty.structure to 'auto', 'diagonal' or 'scalar'"
        )
    else:
        problem = observer_problem(models, unit, uncertain, noise, context)
        try:
            problem.require_sound()
            return problem, ""
        except SynthesisError as error:
            refusal = str(error)
    log.warning("%s: there are no robust observers and no certificates: %s", models.name, refusal)
    return None, refusal


def observer_problem(models: ModelSet, unit: str, uncertain: UncertainModel, noise: Array, context: Context) -> ObserverProblem:
    """Return the synthesis problem of one kind of model."""
    remainder = uncertain.remainder
    return ObserverProblem(
        nominal=models.systems([unit])[0],
        C=np.eye(models.lifting.n_lifted)[list(models.measured)],
        W_L=uncertain.weight.left,
        W_R=uncertain.weight.right,
        input_scale=models.input_scale,
        output_scale=models.output_scale,
        noise=noise,
        n_original=models.lifting.n_states,
        correction_penalty=context.config.synthesis.penalty,
        remainder_left=remainder.left if remainder is not None else None,
        remainder_right=remainder.right if remainder is not None else None,
        injection=Injection(context.config.synthesis.injection),
        form=uncertain.form,
    )


def measurement_noise(context: Context, models: ModelSet) -> Array:
    """Return the standard deviation of every measurement's noise: as declared, else that of the quantisation found in the data."""
    names = [models.lifting.states[i] for i in models.measured]
    declared = context.config.synthesis.noise
    return np.array([declared.get(n, context.facts.resolution[n] / np.sqrt(12)) for n in names])


def tuning_set(context: Context, models: ModelSet) -> TuningSet:
    """Return the training episodes that observers are tuned on: some of the first units, from the first to the last one of each."""
    facts, calibration = context.facts, calibrate.load(context)
    units = [u for u in facts.pooled if u in models.unit_ids][:TUNING_UNITS]
    keys = tuple(k for u in units for k in spread(facts.keys("train", u, facts.identify_on), TUNING_EPISODES))
    parameters: dict[str, dict[str, float]] = {
        u: {} if calibration is None else {calibration.spec.parameter: calibration.units[u].phase_rad} for u in units
    }
    return TuningSet(context.population.select(units), keys, parameters, context.seen(models.measured))


def spread(keys: Sequence[EpisodeKey], count: int) -> list[EpisodeKey]:
    """Return so many episodes from the first to the last: what was recorded one after the other may be alike."""
    if len(keys) <= count:
        return list(keys)
    return [keys[i] for i in np.linspace(0, len(keys) - 1, count).round().astype(int)]


def certified_problem(task: Task, tasks: list[Task], products: list[Product]) -> ObserverProblem | None:
    """Return the set that all observers of a kind of model are certified for: that of its worst-case synthesis, where there is one."""
    for other, product in zip(tasks, products, strict=True):
        if other.models.name == task.models.name and other.method == "worst_case_h2" and product.synthesis is not None:
            return product.problem
    return task.problem


def certificate(task: Task, synthesis: Synthesis, problem: ObserverProblem | None) -> dict[str, Any]:
    """Recompute what can be said about an observer, however it was made, and whether it holds for every unit's model."""
    facts: dict[str, Any] = {"order": states_beside(task, synthesis), "spectral_radius_max": None, "worst_case_h2": None}
    if isinstance(synthesis, OwnModel):
        return facts | {"reason": synthesis.reason}
    if problem is None:
        return facts | {"reason": task.refusal}
    problem = replace(problem, injection=synthesis.injection)
    loop = float(problem.error_system(synthesis.controller).spectral_radius())
    facts["spectral_radius_max"] = max(loop, float(task.models.spectral_radius().max()))
    try:
        facts["worst_case_h2"] = certify(problem, synthesis.controller)[0]
        return facts | (of_units(task, synthesis, problem) if task.method in WORST_CASE else {})
    except SynthesisError as error:
        log.warning("%s: no certificate, %s", task.name, error)
        return facts | {"reason": str(error)}


def states_beside(task: Task, synthesis: Synthesis) -> int:
    """Return the number of states besides the recorded ones: of the correction filter, and of a memory."""
    observer = task.observer(synthesis)
    return observer.controller.n_states + observer.lifting.n_states - len(observer.recorded)


def of_units(task: Task, synthesis: Synthesis, problem: ObserverProblem) -> dict[str, Any]:
    """Return the bound in the other norm, and whether both hold for the models of all units."""
    found = check_units(problem, synthesis.controller, task.models.systems(task.covered), task.covered)
    if not found.holds:
        log.warning("%s: the error of a unit's model is %.3g times its certified bound", task.name, found.largest_ratio)
    gain = found.worst_case_hinf if np.isfinite(found.worst_case_hinf) else None
    facts = {"worst_case_hinf": gain, "causal_h2": synthesis.causal_h2, "bound_holds": found.holds}
    return facts | {"unit_to_bound_max": found.largest_ratio, "unit_to_density_max": float(found.density_ratio.max(initial=0.0))}


def save(context: Context, task: Task, synthesis: Synthesis) -> None:
    """Write the observer and its synthesis, in the recordings' units."""
    observer = in_sizes(task.observer(synthesis), {})
    observer.save(context.store.draft("observers", f"{task.name}.json"))
    replace(synthesis, controller=observer.controller).save(context.store.draft("synthesis", task.name))
