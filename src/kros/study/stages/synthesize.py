"""Stage: synthesise robust observers and the baselines they are compared with."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import load_artifact, save_artifact
from ...core.errors import SynthesisError
from ...core.lti import StateSpace, gain
from ...data.population import EpisodeKey, Population
from ...evaluate import EpisodeBatch, summarise
from ...identify import ModelSet
from ...observer import Observer, kalman_candidates, noise_covariances, run_observer
from ...synthesis import Injection, ObserverProblem, Synthesis, kalman, mixed, worst_case_h2
from ...synthesis.certificate import certify
from ...uncertainty import UncertainModel
from ..context import Context
from . import calibrate

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_TUNING_UNITS = 12
_TUNING_S = 10.0


@dataclass(frozen=True, eq=False)
class Task:
    """Everything a worker needs for one observer."""

    name: str
    method: str
    models: ModelSet
    unit: str
    problem: ObserverProblem | None
    options: dict[str, Any]

    @property
    def nominal(self) -> StateSpace:
        """The nominal unit's model."""
        return self.models.systems([self.unit])[0]


@dataclass(frozen=True, eq=False)
class Product:
    """One observer, or the reason why there is none."""

    name: str
    synthesis: Synthesis | None
    facts: dict[str, Any]


def run(context: Context) -> list[Path]:
    """Synthesise everything, certify everything that can be, save observers."""
    tasks = [task for name in context.model_names for task in _tasks(context, name)]
    work = [partial(_produce, task) for task in tasks]
    products = list(context.map("synthesize", _call, work))
    files = []
    for task, product in zip(tasks, products, strict=True):
        if product.synthesis is not None:
            files += _save(context, task, product)
    made = [p.name for p in products if p.synthesis is not None]
    deployed = choose_deployed(context.config.observer.deployed, made)
    folder = context.store.path("observers")
    save_artifact(folder, "observers", {"names": made, "deployed": deployed, "facts": {p.name: p.facts for p in products}})
    Observer.load(folder / f"{deployed}.json").save(folder / "deployed.json")
    return [*files, folder / "observers.json", folder / "deployed.json"]


def choose_deployed(wanted: str | None, made: list[str]) -> str:
    """Return the observer that is handed over: the one asked for, else the best guarantee of the best model."""
    if wanted is not None:
        if wanted not in made:
            raise SynthesisError(f"observer.deployed = {wanted!r}: there is no such observer, only {', '.join(made)}; name one of them.")
        return wanted
    for method in ("worst_case_h2", "mixed", "kalman_tuned", "kalman_white", "open_loop"):
        for name in made:
            if name.endswith(f"/{method}"):
                return name
    raise SynthesisError("No observer could be made; see the reasons above.")


def _call(task: Any) -> Product:
    product: Product = task()
    return product


def _tasks(context: Context, name: str) -> list[Task]:
    models = context.models(name)
    choice, _ = load_artifact(context.store.path("uncertainty"), "choice")
    unit = choice["nominal"]
    folder = context.store.path("uncertainty", name)
    problem = observer_problem(context, models, unit, UncertainModel.load(folder)) if folder.exists() else None
    config = context.config
    options: dict[str, Any] = {"time_limit_s": config.synthesis.time_limit_s, "max_order": config.uncertainty.max_order}
    options |= {"noise": measurement_noise(context, models), "tuning": _tuning(context, models)}
    methods = config.observer.baselines + (config.synthesis.methods if problem is not None else ())
    return [Task(f"{name}/{method}", method, models, unit, problem, options) for method in methods]


def observer_problem(context: Context, models: ModelSet, unit: str, uncertain: UncertainModel) -> ObserverProblem:
    """Return the synthesis problem of one kind of model."""
    remainder = uncertain.remainder
    return ObserverProblem(
        nominal=models.systems([unit])[0],
        C=np.eye(models.lifting.n_lifted)[list(models.measured)],
        W_L=uncertain.weight.left,
        W_R=uncertain.weight.right,
        input_scale=models.input_scale,
        output_scale=models.output_scale,
        noise=measurement_noise(context, models),
        n_original=models.lifting.n_states,
        correction_penalty=context.config.synthesis.penalty,
        remainder_left=remainder.left if remainder is not None else None,
        remainder_right=remainder.right if remainder is not None else None,
        injection=Injection(context.config.synthesis.injection),
    )


def measurement_noise(context: Context, models: ModelSet) -> Array:
    """Return the standard deviation of every measurement's noise: as declared, else that of the quantisation found in the data."""
    names = [models.lifting.states[i] for i in models.measured]
    declared = context.config.synthesis.noise
    return np.array([declared.get(n, context.facts.resolution[n] / np.sqrt(12)) for n in names])


def _tuning(context: Context, models: ModelSet) -> tuple[Population, tuple[EpisodeKey, ...], dict[str, dict[str, float]]]:
    """Return the training episodes that baselines are tuned on: one of each of the first units."""
    facts = context.facts
    units = [u for u in facts.pooled if u in models.unit_ids][:_TUNING_UNITS]
    calibration = calibrate.load(context)
    keys = tuple(facts.keys("train", u, facts.identify_on)[0] for u in units)
    parameters: dict[str, dict[str, float]] = {u: {} if calibration is None else {calibration.spec.parameter: calibration.units[u].phase_rad} for u in units}
    return context.population.select(units), keys, parameters


def _produce(task: Task) -> Product:
    """Make one observer; a failure is a product too, with its reason."""
    try:
        synthesis, facts = _METHODS[task.method](task)
    except SynthesisError as error:
        log.warning("%s: %s", task.name, error)
        return Product(task.name, None, {"status": "failed", "reason": str(error)})
    return Product(task.name, synthesis, {**facts, **certificate(task, synthesis)})


def _static(task: Task, injection: Injection = Injection.STATE) -> Synthesis:
    from ...synthesis.result import Status

    n, q = task.models.lifting.n_lifted, len(task.models.measured)
    return Synthesis("open_loop", gain(np.zeros((n, q)), task.models.sample_period_s), Status.OPTIMAL, injection)


def _open_loop(task: Task) -> tuple[Synthesis, dict[str, Any]]:
    return _static(task), {}


def _kalman_white(task: Task) -> tuple[Synthesis, dict[str, Any]]:
    models = task.models
    Q, R = noise_covariances(models.residual_covariance, task.options["noise"] * np.sqrt(12))
    return kalman(models.A[models.index(task.unit)], _measures(models), Q, R, models.sample_period_s), {}


def _kalman_tuned(task: Task) -> tuple[Synthesis, dict[str, Any]]:
    """Sweep the process noise; the smallest mean error of the unmeasured states on training episodes wins."""
    models = task.models
    population, keys, units = task.options["tuning"]
    batch = EpisodeBatch.read(population, keys, round(_TUNING_S / models.sample_period_s))
    hidden = [i for i in range(models.lifting.n_states) if i not in models.measured] or list(models.measured)
    R = np.diag(task.options["noise"] ** 2)
    best: tuple[float, float, Synthesis] | None = None
    for level, synthesis in kalman_candidates(models.A[models.index(task.unit)], _measures(models), models.output_scale, R, models.sample_period_s):
        observer = make_observer(task, synthesis)
        values = batch.parameters(units) if models.lifting.parameters else None
        estimate = run_observer(observer, batch.states[..., list(models.measured)], batch.inputs, values)
        error = float(np.mean(summarise(estimate, batch.states, batch.lengths, models.sample_period_s).percent[:, hidden]))
        if np.isfinite(error) and (best is None or error < best[0]):
            best = (error, level, synthesis)
    if best is None:
        raise SynthesisError("Tuned Kalman filter: every candidate diverges on the training episodes.")
    return best[2], {"process_noise_level": best[1], "training_error_percent": best[0]}


def _mixed(task: Task) -> tuple[Synthesis, dict[str, Any]]:
    assert task.problem is not None
    problem = replace(task.problem, injection=Injection.INPUT)
    synthesis = mixed(problem.mixed_plant(), time_limit_s=task.options["time_limit_s"])
    return replace(synthesis, controller=problem.to_physical(synthesis.controller), injection=Injection.INPUT), {}


def _worst_case_h2(task: Task) -> tuple[Synthesis, dict[str, Any]]:
    assert task.problem is not None
    return worst_case_h2(task.problem, max_order=task.options["max_order"]), {}


_METHODS = {
    "open_loop": _open_loop,
    "kalman_white": _kalman_white,
    "kalman_tuned": _kalman_tuned,
    "mixed": _mixed,
    "worst_case_h2": _worst_case_h2,
}


def _measures(models: ModelSet) -> Array:
    return np.eye(models.lifting.n_lifted)[list(models.measured)]


def certificate(task: Task, synthesis: Synthesis) -> dict[str, Any]:
    """Recompute what can be said about an observer, however it was made."""
    facts: dict[str, Any] = {"order": synthesis.controller.n_states, "spectral_radius_max": None, "worst_case_h2": None}
    if task.problem is None:
        return facts
    problem = replace(task.problem, injection=synthesis.injection)
    loop = problem.error_system(synthesis.controller)
    units = max(float(np.max(task.models.spectral_radius()[[task.models.index(u)]])) for u in task.models.unit_ids)
    facts["spectral_radius_max"] = max(float(loop.spectral_radius()), units)
    try:
        facts["worst_case_h2"] = certify(problem, synthesis.controller)[0]
    except SynthesisError as error:
        log.warning("%s: no certificate, %s", task.name, error)
        facts["reason"] = str(error)
    return facts


def make_observer(task: Task, synthesis: Synthesis) -> Observer:
    """Return the observer as it runs."""
    models = task.models
    row = models.index(task.unit)
    return Observer(
        name=task.name,
        lifting=models.lifting,
        A=models.A[row],
        B=models.B[row],
        measured=models.measured,
        inputs=models.inputs,
        controller=synthesis.controller,
        injection=synthesis.injection,
        sample_period_s=models.sample_period_s,
        parameters={name: float(values[row]) for name, values in models.parameters.items()},
    )


def _save(context: Context, task: Task, product: Product) -> list[Path]:
    assert product.synthesis is not None
    path = context.store.path("observers", f"{task.name}.json")
    make_observer(task, product.synthesis).save(path)
    folder = context.store.path("synthesis", task.name)
    product.synthesis.save(folder)
    return [path, folder / "synthesis.json", folder / "arrays.npz"]
