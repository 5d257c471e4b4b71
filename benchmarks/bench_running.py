"""One step of a running observer in Python, names included: what a test bench or a script in the loop pays for a sample.

pytest benchmarks/bench_running.py --benchmark-only

Asked: at most 40 us. Each observer gives the numbers of the batch run before its time counts, which is processor time: other work on the machine
does not inflate it much.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from kros.core.lti import StateSpace, gain
from kros.data import EpisodeBatch
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Observer, Recordings, Seen, identify_estimator
from kros.observer.monitor import Monitor, octaves
from kros.plants import HarmonicDrivePopulation
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


def observer(functions: tuple[str, ...], order: int) -> Observer:
    """An observer of drives with a correction filter of an order."""
    rng = np.random.default_rng(0)
    lifting = Lifting(STATES, functions, ("phase",) if functions else ())
    n, nl = lifting.n_states, lifting.n_lifted
    A = np.zeros((nl, nl))
    A[:n] = 0.3 * rng.normal(size=(n, nl)) / np.sqrt(nl)
    A[:n, n:] *= 0.01  # contracting, since slopes of the lifted functions are 100: else rounding grows
    K = gain(0.1 * rng.normal(size=(nl, 1)), DT)
    if order:
        K = StateSpace(0.5 * np.eye(order), np.ones((order, 1)), 0.01 * rng.normal(size=(nl, order)), K.D, DT)
    B = 0.1 * rng.normal(size=(nl, 2))
    phase = {"phase": 1.0} if functions else {}
    return Observer("o", lifting, A, B, (0,), INPUTS, K, Injection.STATE, DT, phase, seen=SEEN)


def estimator(order: int) -> Observer:
    """The estimator of simulated drives with so many filters, and with a monitor."""
    drives = HarmonicDrivePopulation(2, 2, 2.0).simulate().population
    phases = {unit: {"phase": 1.0} for unit in drives.unit_ids}
    recordings = Recordings.of(list(drives.keys()), lambda key: EpisodeBatch.read(drives, [key], None, phases))
    settings = EstimatorSettings(order=order)
    found = identify_estimator(
        "o", Lifting(STATES, GEAR, ("phase",)), (0,), INPUTS, recordings, DT, {"phase": 1.0}, settings
    )
    return replace(found.observer, monitor=WATCH, seen=SEEN)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize(
    "make",
    [
        lambda: observer((), 0),
        lambda: observer(GEAR[:1], 6),
        lambda: estimator(12),
        lambda: estimator(32),
    ],
    ids=["linear", "filter_of_order_6", "estimator_12", "estimator_32"],
)
def test_step(benchmark, request, make) -> None:
    own = make()
    rng = np.random.default_rng(1)
    y, u = 0.3 * np.clip(rng.normal(size=(SAMPLES, 1)), -3, 3), 0.3 * np.clip(rng.normal(size=(SAMPLES, 2)), -3, 3)
    running = own.start(y[0])
    found = np.array([np.asarray(running.step(y[k], u[k])) for k in range(SAMPLES - 1)])
    expected = own.run(y[:, None], u[:, None])[1:, 0]
    np.testing.assert_allclose(
        found, expected, rtol=0, atol=1e-9
    )  # a velocity is a difference over 1 ms: rounding times 1000

    def steps() -> float:
        for k in range(SAMPLES):
            estimate = running.step(y[k], u[k])["velocity"]
        return estimate

    benchmark(steps)
    if benchmark.stats is not None:
        benchmark.extra_info["observer"] = request.node.callspec.id.replace("_", " ")
        benchmark.extra_info["us_a_step"] = round(1e6 * benchmark.stats.stats.median / SAMPLES, 1)
