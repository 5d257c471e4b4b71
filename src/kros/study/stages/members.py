"""Monte Carlo over the uncertain sets of a study: every certified observer on random members of the set that it is certified for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...design.methods.disturbance_model import DisturbanceModel
from ...design.synthesize import measurement_noise
from ...design.task import split_name
from ...design.uncertain_set import usable_problem
from ...evaluate import sample_errors
from ...synthesis import ObserverProblem, Synthesis
from ..engine.context import Context

Array = npt.NDArray[np.float64]
Members = dict[str, tuple[dict[str, Any], dict[str, Array]]]
_SHARES = (0.05, 0.5, 0.95)


def member_work(context: Context, kind: str, members: int) -> Callable[[], Members]:
    """Return the work of running the certified observers of one kind of model on random members of its set; it finds nothing where nothing is certified."""
    facts = context.observers_record["facts"]
    bounds = {
        name: float(own["worst_case_h2"])
        for name, own in facts.items()
        if split_name(name)[0] == kind and own.get("worst_case_h2") is not None
    }
    if not bounds:
        return dict
    models, uncertain, settings = context.identified.models(kind), context.uncertain.sets[kind], context.config.synthesis
    base, _ = usable_problem(models, uncertain, measurement_noise(context.identified, models, context.config.sensor), settings)
    assert base is not None  # there are bounds
    assumed = DisturbanceModel.recorded(
        facts.get(f"{kind}/worst_case_h2", {})
    )  # observers are certified with what the worst-case synthesis chose
    problem = base if assumed is None else assumed.of(base)
    syntheses = {name: Synthesis.load(context.store.path("synthesis", name)) for name in bounds}
    return partial(run_on_members, problem, syntheses, bounds, members, models.systems(uncertain.unit_ids))


def run_on_members(
    problem: ObserverProblem, syntheses: Mapping[str, Synthesis], bounds: Mapping[str, float], members: int, units: StateSpace
) -> Members:
    """Return for every observer a row for the metrics, and its norms over ``members`` and ``units``."""
    found = sample_errors(problem, [(s.controller, s.injection) for s in syntheses.values()], members, units)
    rows = {}
    for i, name in enumerate(syntheses):
        row: dict[str, Any] = {"observer": name, "members": members, "bound": bounds[name], "largest": float(found.largest[i])}
        row |= {"exceeded": bool(found.largest[i] > bounds[name]), "noise": float(found.noise[i])}
        row |= {"quantiles": dict(zip(map(str, _SHARES), np.quantile(found.norms[i], _SHARES).tolist(), strict=True))}
        row |= {"unit_median": float(np.median(found.units[i])), "unit_worst": float(found.units[i].max())}
        rows[name] = (row, {"members": found.norms[i], "units": found.units[i]})
    return rows
