"""Observers that can run side by side."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ...observer import Observer

_SIDE_BY_SIDE = 8  # observers of one piece of work: few enough to keep all processes busy


def alike(observers: Iterable[Observer]) -> list[list[Observer]]:
    """Return observers in groups that can run side by side: of one lifting, with the same parameters, measured states and inputs."""
    groups: list[list[Observer]] = []
    for observer in observers:
        key = _model_of(observer)
        group = next((g for g in groups if len(g) < _SIDE_BY_SIDE and _model_of(g[0]) == key), None)
        if group is None:
            groups.append([observer])
        else:
            group.append(observer)
    return groups


def _model_of(observer: Observer) -> tuple[Any, ...]:
    return observer.lifting, dict(observer.parameters), observer.measured, observer.inputs
