"""Monte Carlo over the uncertain sets of a study: every certified observer on random members of the set that it is certified for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import load_artifact
from ...core.lti import StateSpace
from ...design.task import IDENTITY, Surroundings
from ...evaluate import Candidate, sample_errors
from ...synthesis import ObserverProblem, Synthesis
from ...uncertainty import UncertainModel
from ..engine.context import Context

Array = npt.NDArray[np.float64]
Members = dict[str, tuple[dict[str, Any], dict[str, Array]]]
_SHARES = (0.05, 0.5, 0.95)


def member_work(context: Context, model: str, members: int) -> Callable[[], Members]:
    """Return the work of running the certified observers of one kind of model on random members of its set; it finds nothing where nothing is certified."""
    from .synthesize import measurement_noise, usable_problem

    record = load_artifact(context.store.path("observers"), "observers")[0]
    bounds = {
        name: float(facts["worst_case_h2"])
        for name, facts in record["facts"].items()
        if name.rpartition("/")[0] == model and facts.get("worst_case_h2") is not None
    }
    if not bounds:
        return dict
    models, uncertain = context.identified.models(model), UncertainModel.load(context.store.path("uncertainty", model))
    unit = load_artifact(context.store.path("uncertainty"), "choice")[0]["nominal"]
    base, _ = usable_problem(models, unit, uncertain, measurement_noise(context, models), context)
    assert base is not None  # there are bounds
    problem = certified_for(base, record["facts"].get(f"{model}/worst_case_h2", {}))
    syntheses = {name: Synthesis.load(context.store.path("synthesis", name)) for name in bounds}
    return partial(run_on_members, problem, syntheses, bounds, members, models.systems(uncertain.unit_ids))


def certified_for(base: ObserverProblem, facts: Mapping[str, Any]) -> ObserverProblem:
    """Return the set that observers are certified for: in the surroundings that the worst-case synthesis chose, where it was made."""
    if "process_noise" not in facts:
        return base
    corner = facts["input_weight_hz"]
    return Surroundings(IDENTITY if corner is None else corner, facts["process_noise"], facts["measurement_noise"]).of(base)


def run_on_members(
    problem: ObserverProblem, syntheses: Mapping[str, Synthesis], bounds: Mapping[str, float], members: int, units: StateSpace
) -> Members:
    """Return for every observer a row for the metrics, and its norms over ``members`` and ``units``."""
    found = sample_errors(problem, [Candidate(s.controller, s.injection) for s in syntheses.values()], members, units)
    rows = {}
    for i, name in enumerate(syntheses):
        row: dict[str, Any] = {"observer": name, "members": members, "bound": bounds[name], "largest": float(found.largest[i])}
        row |= {"exceeded": bool(found.largest[i] > bounds[name]), "noise": float(found.noise[i])}
        row |= {"quantiles": dict(zip(map(str, _SHARES), np.quantile(found.norms[i], _SHARES).tolist(), strict=True))}
        row |= {"unit_median": float(np.median(found.units[i])), "unit_worst": float(found.units[i].max())}
        rows[name] = (row, {"members": found.norms[i], "units": found.units[i]})
    return rows
