"""Certificates of observers with a delay and limits, against the code that runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adversary import attack, attack_running
from batches import batch_of
from contracting import DT, contracting, recordings
from frozen import compared

from kros.evaluate.sensor import as_shown
from kros.observer import ReliftScales, Runtime, Sensor, relift_certificate, run_observer
from kros.observer.certificate.error import error_system, state_sizes
from kros.synthesis import Injection


def late(states: np.ndarray, delay: int) -> np.ndarray:
    return states[np.maximum(np.arange(len(states)) - delay, 0)][..., :1]


LINEAR = [(), ("a[-1]",), ("b[-2]", "a[-1]")]
BENT = [("sin(2*a)",), ("sin(a + b)", "u[-1]*1"), ("cos(b[-1])",)]


@pytest.mark.parametrize(
    ("delay", "injection", "functions"),
    [(0, injection, functions) for injection in (Injection.STATE, Injection.INPUT) for functions in LINEAR + BENT]
    + [(delay, Injection.STATE, functions) for delay in (1, 4) for functions in LINEAR],
)
def test_the_error_system_is_the_observer_as_it_runs(delay, injection, functions) -> None:
    """Start, chain of predictions and correction filter: linear functions leave nothing to bound, and the frozen response is the error, to rounding."""
    upper = np.array([np.inf, 9.0, np.inf]) if delay == 1 else None
    observer, (x, u) = contracting(functions, injection=injection, delay=delay, upper=upper), recordings(size=3.0)
    found = relift_certificate(observer)
    assert found.certified, found.reason
    estimates = run_observer(observer, late(x, delay), u)
    rows = compared(found, observer, batch_of(x, u, DT), estimates)
    assert all(row.holds for row in rows)
    errors = np.sqrt(np.mean(np.sum((x - estimates) ** 2, axis=2), axis=0))
    assert [row.error for row in rows] == pytest.approx(errors, rel=1e-12)
    exact = [row.frozen == pytest.approx(row.error, rel=1e-9) for row in rows]
    assert set(exact) == {not found.channels}


@pytest.mark.parametrize("delay", [0, 2])
def test_what_a_sensor_shows_beside_the_states_drives_the_frozen_response(delay: int) -> None:
    noisy = contracting(delay=delay)
    found = relift_certificate(noisy)
    x, u = recordings()
    sensor = {"a": Sensor(noise=5.0, bias=2.0, resolution=0.1, delay_samples=delay)}
    batch = as_shown(batch_of(x, u, DT), sensor, ("a", "b", "c"))
    rows = compared(found, noisy, batch)
    assert [row.frozen for row in rows] == pytest.approx([row.error for row in rows], rel=1e-9)
    assert all(row.holds for row in rows)
    without = compared(found, noisy, batch_of(x, u, DT), run_observer(noisy, batch.measurements((0,)), u))
    assert not all(row.frozen == pytest.approx(row.error, rel=1e-3) for row in without)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_sizes_of_the_error_system_are_those_of_what_its_states_are(delay: int) -> None:
    late = contracting(("b[-2]",), delay=delay)
    system = error_system(late)
    window = sum(name in late.lifting.states for name, _ in late.lifting.window.quantities)
    sizes = state_sizes(late, ReliftScales.ones(late), np.arange(1.0, window + 1))
    filters, behind = np.ones(2), [*np.tile(np.arange(1.0, window + 1), delay), 1.0, 2.0, 3.0] if delay else []
    np.testing.assert_array_equal(sizes, [*np.arange(1.0, window + 1), *filters, *behind])
    assert len(sizes) == len(system.A)


RUNTIMES = {"none": {}, "delay": {"delay": 3}, "limits": {"lower": np.full(3, -0.35), "upper": np.full(3, 0.35)}}


@pytest.mark.parametrize("what", RUNTIMES)
def test_bounds_hold_for_the_observer_as_it_runs(what: str) -> None:
    """Recordings of another machine, random and worst disturbances at many amplitudes; limits cut off, and that is seen."""
    o = contracting(("0.3*sin(3*a)", "0.2*cos(2*b)"), **RUNTIMES[what])
    scales = ReliftScales(np.ones(3), np.array([0.1, 0.2, 0.1]), np.array([0.05]))
    found = relift_certificate(o, scales=scales)
    assert found.certified, found.reason
    x, u = recordings()
    estimates = run_observer(o, late(x, o.runtime.delay), u)
    rows = compared(found, o, batch_of(x, u, DT), estimates)
    assert all(row.holds for row in rows)
    free = run_observer(replace(o, runtime=Runtime(delay=o.runtime.delay)), late(x, o.runtime.delay), u)
    assert (what != "limits") == np.array_equal(free, estimates)
    worst = attack(found, o, steps=20000)
    assert worst.share <= 1
    rng = np.random.default_rng(5)
    for disturbance in (worst.disturbance, rng.standard_normal((400, 4))):
        start = 0.2 * rng.uniform(-1, 1, (40, 3))
        share, steps = attack_running(
            found,
            o,
            disturbance,
            start,
            0.1 * rng.standard_normal((len(disturbance) + 1, 40, 1)),
            amplitudes=(1e-3, 10.0),
        )
        assert 0.05 < share <= 1
        assert steps > 500
