"""An observer in other units of measure: the same estimates from the same machine, every signal divided by another size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from ..core.lti import StateSpace
from ..synthesis.result import Injection
from .data import ObserverData
from .runtime import Runtime
from .sensor import in_units

Array = npt.NDArray[np.float64]
O = TypeVar("O", bound=ObserverData)  # noqa: E741


def in_sizes(observer: O, sizes: Mapping[str, float]) -> O:
    """Return the observer for states and inputs divided by sizes."""
    lifting = observer.lifting.in_sizes(sizes)
    x, u = factors(observer, sizes)
    y, K = x[list(observer.measured)], observer.controller
    into = u if observer.injection is Injection.INPUT else x
    return replace(
        observer,
        lifting=lifting,
        A=observer.A * x[:, None] / x,
        B=observer.B * x[:, None] / u,
        controller=StateSpace(K.A, K.B / y, K.C * into[:, None], K.D * into[:, None] / y, K.dt),
        runtime=_runtime(observer.runtime, x[: lifting.n_states], y, into, u),
        seen=None if observer.seen is None else observer.seen.times(y, u[: len(observer.inputs)]),
        monitor=None if observer.monitor is None else observer.monitor.times(y),
        guard=None if observer.guard is None else observer.guard.times(x[: lifting.n_states]),
        bank=None if observer.bank is None else observer.bank.times(x[: lifting.n_states], np.concatenate([x, u]), y),
        sensor=in_units(observer.sensor, {lifting.states[i]: 1 / float(x[i]) for i in observer.measured}),
    )


def factors(observer: ObserverData, sizes: Mapping[str, float]) -> tuple[Array, Array]:
    """Return what lifted states and inputs are multiplied by where other sizes take the place of an observer's own."""
    old, new = observer.lifting, observer.lifting.in_sizes(sizes)
    inputs = (*observer.inputs, *old.input_functions)
    x, u = (old.sizes_of(names) / new.sizes_of(names) for names in (old.names, inputs))
    if observer.bank is not None:  # what is estimated from inputs alone has the units of the recorded states
        n, recorded = old.n_states, len(observer.recorded)
        x[n - recorded : n] = x[:recorded]
    return x, u


def _runtime(runtime: Runtime, x: Array, y: Array, into: Array, u: Array) -> Runtime:
    by = {"lower": x, "upper": x, "correction": into}
    by |= {
        name: u[: len(limit)]
        for name in ("input_lower", "input_upper")
        if (limit := getattr(runtime, name)) is not None
    }
    return replace(
        runtime, **{name: getattr(runtime, name) * by[name] for name in by if getattr(runtime, name) is not None}
    )
