"""The methods of observer design, in one table: in which order they are named, which start first, and which are preferred."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from ...identify.model_set import kind_of
from ..task import split_name

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Method:
    """One way to an observer."""

    name: str
    seconds: (
        float  # roughly what it takes: those that take longest start first, so that no worker waits for them in the end
    )
    rank: int  # the observer of the lowest rank is deployed where none is named and others are no better
    not_refined: str = ""  # why it is not made for refined models; empty where it is made for all
    once: str = ""  # why it is made once for a lifting, for the refined models where there are any; empty where for all


_LIFTED = "the paper's problem spends its correction on lifted modes that the observer as it runs does not have"
_FITTED = "it is fitted to recordings, not to models, and would be that of the refined ones again"
METHODS = (
    Method("open_loop", 0.0, 9),
    Method("kalman_tuned", 1.0, 6),
    Method("mixed", 3.0, 3, not_refined=_LIFTED),
    Method("paper", 1.5, 10, not_refined=_LIFTED),
    Method("worst_case_h2", 4.0, 1),
    Method("residual_h2", 2.0, 4),
    Method("estimator", 5.0, 0, once=_FITTED),
)
BY_NAME = {method.name: method for method in METHODS}


def suitable(wanted: Iterable[str], kind: str, kinds: Collection[str]) -> list[Method]:
    """Return the methods that are made for one of the kinds of models, in the order of the table; the reasons of others are logged."""
    found, refined = [], kind_of(kind).refined
    again = not refined and kind.removesuffix("_edmd") in kinds
    for method in METHODS:
        if method.name in set(wanted):
            if refined and method.not_refined:
                log.info("%s/%s is not made for refined models: %s.", kind, method.name, method.not_refined)
            elif method.once and again:
                log.info("%s/%s is made for refined models alone: %s.", kind, method.name, method.once)
            else:
                found.append(method)
    return found


def slowest_first(names: list[str]) -> list[int]:
    """Return the order in which to start methods."""
    return sorted(range(len(names)), key=lambda i: -BY_NAME[names[i]].seconds)


def preferred(observers: list[str]) -> str | None:
    """Return the first observer ``<kind of model>/<method>`` of the lowest rank; None where no method is of the table."""
    ranks = {name: BY_NAME[method].rank for name in observers if (method := split_name(name)[1]) in BY_NAME}
    return min(ranks, key=lambda name: ranks[name], default=None)
