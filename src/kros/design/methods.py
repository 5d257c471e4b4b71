"""The methods of a study, in one table: in which order they are told, which start first, which is handed over, and which models they are for."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Method:
    """One way to an observer.

    Parameters
    ----------
    name : str
    seconds : float
        Roughly what it takes: those that take longest start first, so that no worker waits for them in the end.
    rank : int
        The observer of the lowest rank is handed over where the study names none.
    not_refined, refined_only : str
        Why it is not made for refined models, or for these alone; empty where it is made for all.
    """

    name: str
    seconds: float
    rank: int
    not_refined: str = ""
    refined_only: str = ""


_LIFTED = "the paper's problem spends its correction on lifted modes that the observer as it runs does not have"
METHODS = (
    Method("open_loop", 0.0, 9),
    Method("kalman_white", 0.0, 8),
    Method("kalman_tuned", 1.0, 6),
    Method("luenberger", 0.5, 7),
    Method("mixed", 0.9, 3, _LIFTED),
    Method("paper", 1.5, 10, _LIFTED),
    Method("worst_case_h2", 4.0, 1),
    Method("worst_case_hinf", 8.0, 2),
    Method("residual_h2", 2.0, 4),
    Method("memory", 5.0, 5, refined_only="it is fitted to recordings, not to models, and would be that of the refined ones again"),
)
_BY_NAME = {method.name: method for method in METHODS}


def suitable(wanted: Iterable[str], model: str, refined: bool) -> list[Method]:
    """Return the methods that are made for a kind of model, in the order of the table; those that are left out are logged with the reason."""
    found = []
    for method in METHODS:
        if method.name in set(wanted):
            if refined and method.not_refined:
                log.info("%s/%s is not made for refined models: %s.", model, method.name, method.not_refined)
            elif method.refined_only and not refined:
                log.info("%s/%s is made for refined models alone: %s.", model, method.name, method.refined_only)
            else:
                found.append(method)
    return found


def slowest_first(names: list[str]) -> list[int]:
    """Return the order in which to start methods."""
    return sorted(range(len(names)), key=lambda i: -_BY_NAME[names[i]].seconds)


def preferred(observers: list[str]) -> str | None:
    """Return the first observer ``<model>/<method>`` of the lowest rank; None where no method is of the table."""
    ranks = {name: _BY_NAME[name.rpartition("/")[2]].rank for name in observers if name.rpartition("/")[2] in _BY_NAME}
    return min(ranks, key=lambda name: ranks[name], default=None)
