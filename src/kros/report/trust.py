"""What is certified about an observer, in one place: every table and sentence that speaks of it asks here.

Two sets are never mixed: that of plants, around the nominal unit between the weights, and that of signals, the residuals of recorded motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..evaluate import Kind
from .disturbances import curves, needed
from .error_tables import ErrorTable
from .names import BASELINES, number, split_observer

Facts = Mapping[str, Any]


@dataclass(frozen=True)
class Trust:
    """What stands behind one observer."""

    plants: float | None = None  # certified H2 norm of the error over the set of plants; None where there is none
    signals: Mapping[str, float] | None = None
    outside: tuple[str, ...] = ()  # units whose own signals are outside that set
    running: bool | None = None  # whether a bound was found for it as it runs
    gain: float | None = None  # of that bound, from residual to error
    dropouts: tuple[float, bool] | None = None

    @property
    def by_set(self) -> str:
        """For which sets it is certified, in words."""
        found = [
            name for name, known in (("plants", self.plants is not None), ("signals", bool(self.signals))) if known
        ]
        return " and ".join(found) or "no"

    @property
    def as_it_runs(self) -> str:
        """Whether it is certified as it runs, in words."""
        return {True: f"yes, gain {number(self.gain)}", False: "no", None: "no model"}[self.running]


def trust_of(facts: Facts) -> Trust:
    """Return what an entry of ``observers`` in ``metrics.json`` says."""
    signals = facts.get("set_bound_percent") if facts.get("set_certified") else None
    lost = (
        None
        if facts.get("dropout_rate") is None
        else (float(facts["dropout_rate"]), bool(facts.get("dropout_certified")))
    )
    return Trust(
        facts.get("worst_case_h2"),
        signals,
        tuple(facts.get("set_outside") or ()),
        facts.get("relift_certified"),
        facts.get("relift_gain"),
        lost,
    )


def trusts(metrics: Facts) -> dict[str, Trust]:
    """Return it of all observers that were made, baselines included."""
    found: dict[str, Facts] = {r["observer"]: {} for r in metrics.get("evaluation", [])}
    found |= {name: facts for name, facts in metrics.get("observers", {}).items() if facts.get("status") != "failed"}
    return {name: trust_of(facts) for name, facts in found.items()}


def best_certified(metrics: Facts, table: ErrorTable, channels: Sequence[str]) -> str | None:
    """Return the most accurate observer that was designed and is certified for the set of plants; for recorded signals where there is none."""
    found = trusts(metrics)
    for known in (lambda t: t.plants is not None, lambda t: bool(t.signals)):
        names = [n for n, t in found.items() if known(t) and n in table.cells and split_observer(n)[1] not in BASELINES]
        errors = {n: mean_error(table, n, channels) for n in names}
        if any(np.isfinite(e) for e in errors.values()):
            return min(errors, key=lambda n: errors[n])
    return None


def mean_error(table: ErrorTable, name: str, channels: Sequence[str]) -> float:
    """Return the geometric mean of an observer's errors in some channels, percent of the largest value; infinite where one is not known."""
    values = [table.cells[name][c].mean if c in table.cells[name] else None for c in channels]
    known = [v for v in values if v is not None]
    return (
        float(np.exp(np.mean(np.log(np.maximum(known, 1e-300)))))
        if known and len(known) == len(values)
        else float("inf")
    )


def sensor_text(metrics: Facts, name: str, measured: Sequence[str]) -> str:
    """Return what sensor and timing an observer needs, short."""
    own = curves(metrics.get("robustness", []), metrics["study"]["identify_on"]).get(name)
    return (
        "not tried"
        if own is None
        else "; ".join(needed(own, measured, tuple(_SENSOR), _SENSOR)) or "any that was tried"
    )


def dropout_text(metrics: Facts, name: str, trust: Trust, measured: Sequence[str]) -> str:
    """Return which losses an observer tolerates: certified where a rate is declared, and as tried."""
    told = (
        []
        if trust.dropouts is None
        else [f"{'certified' if trust.dropouts[1] else 'not certified'} at {100 * trust.dropouts[0]:g} %"]
    )
    own = curves(metrics.get("robustness", []), metrics["study"]["identify_on"]).get(name)
    if own is not None:
        told += needed(own, measured, tuple(_LOSSES), _LOSSES) or ["none that was tried doubles the error"]
    return "; ".join(told) or "not tried"


_SENSOR = {
    Kind.NOISE: "noise {} %",
    Kind.QUANTISATION: "resolution {} %",
    Kind.BIAS: "bias {} %",
    Kind.DELAY: "delay {}",
    Kind.PHASE: "phase {} rad",
}
_LOSSES = {Kind.DROPPED: "doubles at {} %", Kind.GAP: "doubles with gaps of {} samples"}
