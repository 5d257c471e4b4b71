"""One step of a running observer in Python, names included: what a test bench or a script in the loop pays for a sample.

pytest benchmarks/bench_running.py --benchmark-only

Asked: at most 40 us. Each observer gives the numbers of the batch run before its time counts, which is processor time: other work on the machine
does not inflate it much.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kros.core.lti import StateSpace, gain
from kros.lifting import Lifting
from kros.observer import Monitor, Observer, Runtime, Seen
from kros.observer.monitor import octaves
from kros.synthesis import Injection

DT, SAMPLES = 1e-3, 2000
GEAR = ("sin(100*position + phase)", "cos(100*position + phase)")
STATES, INPUTS = ("position", "velocity", "current"), ("target_position", "target_velocity")
WATCH = Monitor(
    octaves(),
    forget=1e-3,
    settle=100,
    size=np.ones(1),
    weights=np.array([[3, 3, 3, 3, 2, 2]]),
    limits=np.full((1, 6), 10.0),
    false_alarm_rate=0.02,
)
SEEN = Seen(np.ones(1), np.ones(2))
CURRENT = Runtime(upper=np.array([np.inf, np.inf, 0.5, *[np.inf] * 12]), relift=False)


def observer(functions: tuple[str, ...], internal: int, order: int, **parts: Any) -> Observer:
    """An observer of drives: with internal states as a predictor has them, or with a correction filter of an order."""
    rng = np.random.default_rng(0)
    lifting = Lifting(
        (*STATES, *(f"memory_{i + 1}" for i in range(internal))), functions, ("phase",) if functions else ()
    )
    n, nl = lifting.n_states, lifting.n_lifted
    A = np.zeros((nl, nl))
    A[:n] = 0.3 * rng.normal(size=(n, nl)) / np.sqrt(nl)
    A[:n, n:] *= 0.01  # contracting, since slopes of the lifted functions are 100: else rounding grows
    K = gain(0.1 * rng.normal(size=(nl, 1)), DT)
    if order:
        K = StateSpace(0.5 * np.eye(order), np.ones((order, 1)), 0.01 * rng.normal(size=(nl, order)), K.D, DT)
    B = 0.1 * rng.normal(size=(nl, 2))
    found = Observer(
        "o",
        lifting,
        A,
        B,
        (0,),
        INPUTS,
        K,
        Injection.STATE,
        DT,
        {"phase": 1.0} if functions else {},
        internal=internal,
        seen=SEEN,
    )
    return replace(found, **parts)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize(
    ("functions", "internal", "order", "parts"),
    [
        ((), 0, 0, {}),
        (GEAR[:1], 0, 6, {}),
        (GEAR, 12, 0, {"monitor": WATCH}),
        (GEAR, 32, 0, {"monitor": WATCH}),
        (GEAR, 12, 0, {"monitor": WATCH, "runtime": CURRENT}),
    ],
    ids=["linear", "filter_of_order_6", "predictor_15", "predictor_35", "predictor_15_limited"],
)
def test_step(benchmark, request, functions, internal, order, parts) -> None:
    own = observer(functions, internal, order, **parts)
    rng = np.random.default_rng(1)
    y, u = 0.3 * np.clip(rng.normal(size=(SAMPLES, 1)), -3, 3), 0.3 * np.clip(rng.normal(size=(SAMPLES, 2)), -3, 3)
    running = own.start(y[0])
    found = np.array([np.asarray(running.step(y[k], u[k])) for k in range(SAMPLES - 1)])
    np.testing.assert_allclose(found, own.run(y[:, None], u[:, None])[1:, 0], rtol=0, atol=1e-12)

    def steps() -> float:
        for k in range(SAMPLES):
            estimate = running.step(y[k], u[k])["velocity"]
        return estimate

    benchmark(steps)
    if benchmark.stats is not None:
        benchmark.extra_info["observer"] = request.node.callspec.id.replace("_", " ")
        benchmark.extra_info["us_a_step"] = round(1e6 * benchmark.stats.stats.median / SAMPLES, 1)
