"""Load estimates against analytic loads, a linear machine under a known step, and the simulator's truth."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from batches import batch_of
from load_baselines import ripple_power

from kros.core.errors import DataError, DimensionError
from kros.lifting import Lifting
from kros.motor_drive import AngleLoad
from kros.motor_drive.observer import LoadSettings, load_observer
from kros.motor_drive.signals import TorqueScale, known_load, load_accuracy, without_level
from kros.observer import ReliftScales, run_observer
from kros.observer.estimator.certificate import filter_certificate
from kros.plants import HarmonicDrivePopulation

DT = 1e-3
TIME = np.arange(5000) * DT


def test_a_mounted_mass_takes_gravity_and_inertia() -> None:
    """theta = a sin(w t) has the acceleration -w^2 theta."""
    position = 0.4 * np.sin(2 * np.pi * TIME)
    load = known_load(position, DT, 0.2, 0.01)
    truth = 0.2 * np.sin(position) - 0.01 * (2 * np.pi) ** 2 * position
    assert np.abs(load - truth)[500:-500].max() < 1e-4


def test_a_constant_load_leaves_no_trace_and_a_step_is_forgotten() -> None:
    assert not without_level(np.full(1000, 0.7), 2.0, DT).any()
    step = (TIME >= 1).astype(float)
    np.testing.assert_allclose(without_level(step, 2.0, DT)[1000:], np.exp(-np.arange(4000) * DT / 2.0), rtol=1e-9)


def test_the_torque_constant_from_one_known_load() -> None:
    """An error of the current that is the torque over 40 N m, with a bias: both are found exactly, and the torque with them."""
    torque = 8.0 * np.sin(np.pi * TIME)
    error = torque / 40.0 + 0.01
    scale = TorqueScale.calibrated(error, torque, DT)
    assert scale.torque_constant == pytest.approx(40.0, rel=1e-9)
    np.testing.assert_allclose(scale.load(error), torque, atol=1e-3)
    with pytest.raises(DataError, match="check signs"):
        TorqueScale.calibrated(-error, torque, DT)


def test_the_level_of_an_angle_fixed_load_comes_back() -> None:
    """What is seen starts at zero; after a second of moves the level is there, whatever load it started under."""
    position = np.stack([1.0 + 3.0 * TIME, -2.0 + 0.5 * np.sin(4 * TIME)], axis=1)
    load = 0.2 * np.sin(position)
    seen = without_level(load, 2.0, DT)
    found = AngleLoad(2.0, DT, settling_s=1e-6).run(seen, seen, position).load
    assert np.abs(found - load)[1000:].max() < 1e-3
    assert np.abs(seen - load)[1000:2000].max() > 0.05
    alone = AngleLoad(2.0, DT).run(np.zeros_like(seen[:500]), seen[:500], position[:500]).load
    assert not alone.any()  # nothing seen, nothing filled in


def test_the_level_bears_a_controller_at_its_limit() -> None:
    """From 3 s on the integrator differs by 2: without the limit the load is off by as much, with it the angle says what the load is."""
    position = (3.0 * TIME)[:, None]
    load = 0.2 * np.sin(position)
    wrong = np.where(TIME >= 3, 2.0, 0.0)[:, None]
    seen = without_level(load + wrong, 50.0, DT)
    free = AngleLoad(50.0, DT).run(seen, seen, position).load
    limited = AngleLoad(50.0, DT, limit=1.0).run(seen, seen, position)
    assert np.abs(free - load)[3500:].max() > 1.0
    assert np.abs(limited.load - load)[3500:].max() < 0.05
    assert np.abs(limited.current).max() <= 1.0
    with pytest.raises(DimensionError, match="n_samples, batch"):
        AngleLoad(2.0, DT).run(seen[:, 0], seen[:, 0], position[:, 0])


@pytest.fixture(scope="module")
def drives() -> SimpleNamespace:
    """Three drives, the load known on the first; an observer that learned from it, and what it says of the others."""
    simulated = HarmonicDrivePopulation(n_units=3, n_episodes=3, seconds=7.0, seed=1, loop="soft").simulate()
    population, truth = simulated.population, simulated.truth
    train = [
        k
        for k in population.episodes
        if k.episode != "2" and (k.condition == "noload" or k.unit == population.unit_ids[0])
    ]
    test = [k for k in population.episodes if k.episode == "2" and k.unit != population.unit_ids[0]]
    phases = dict(zip(truth.unit_ids, truth.phase_rad, strict=True))

    def read(keys: list) -> SimpleNamespace:
        values = np.stack([population.read(k) for k in keys], axis=1)
        load = np.stack(
            [truth.load_torque[k] if k.condition == "load" else np.zeros(len(values)) for k in keys], axis=1
        )
        phase = np.array([phases[k.unit] for k in keys])
        x, u = values[..., :3], values[..., 3:]
        batch = replace(batch_of(x, u, DT, {"phase": phase}), keys=tuple(keys))
        return SimpleNamespace(x=x, u=u, load=load.astype(float), phase={"phase": phase}, batch=batch)

    known, others = read(train), read(test)
    lifting = Lifting(population.states, ("sin(100*position + phase)",), ("phase",))
    settings = LoadSettings(current=2, corner_hz=20.0)
    observer, _ = load_observer("koopman/load", lifting, (0,), population.inputs, known.batch, known.load, settings)
    estimate = run_observer(observer, others.x[..., :1], others.u, others.phase)
    leveled = AngleLoad(settings.level_s, DT).run(estimate[..., 3], estimate[..., 2], others.x[..., 0])
    return SimpleNamespace(known=known, others=others, observer=observer, estimate=estimate, leveled=leveled)


def test_loads_of_units_that_took_no_part_are_found(drives: SimpleNamespace) -> None:
    """Slow errors under load stay near the floor without, with the level and for the seen part."""
    accuracy = load_accuracy(drives.leveled.load, drives.others.load, DT, skip=2000)
    assert accuracy.error_rms < 0.2 * accuracy.load_rms
    assert accuracy.ratio < 1.6  # the floor without a load is 12 % of the loads: a lower one makes the ratio larger
    assert accuracy.percent < 35
    seen = load_accuracy(drives.estimate[..., 3], without_level(drives.others.load, 10.0, DT), DT)
    assert seen.error_rms < 0.15 * seen.load_rms
    assert seen.ratio < 1.7  # as above: the floor is 8 % of the loads


def test_ripple_in_the_load_is_far_below_that_of_the_current(drives: SimpleNamespace) -> None:
    """The gear's share of the recorded current, which the paper's linear estimate hands on, is down by more than 10 dB."""
    free = ~drives.others.load.any(axis=0)
    position, speed = drives.others.x[:, free, 0], drives.others.u[:, free, 1]
    powers = [
        ripple_power(s[:, free], position, speed, 100.0, DT) for s in (drives.estimate[..., 3], drives.others.x[..., 2])
    ]
    assert 10 * np.log10(powers[1].mean() / powers[0].mean()) > 10


def test_the_load_observer_is_certified_as_it_runs(drives: SimpleNamespace) -> None:
    scales = ReliftScales(np.ones(4), np.ones(4), np.ones(1))
    assert filter_certificate(drives.observer, scales).certified


def test_calibration_says_what_it_misses(drives: SimpleNamespace) -> None:
    known, lifting = drives.known, Lifting(("position", "velocity", "current"))
    batch = batch_of(known.x, known.u, DT)
    with pytest.raises(DataError, match="with and without load"):
        load_observer("load", lifting, (0,), ("u",), batch, 0 * known.load, LoadSettings(current=2))
    with pytest.raises(DataError, match="come to the current's limit"):
        load_observer("load", lifting, (0,), ("u",), batch, known.load, LoadSettings(current=2, limit=0.1))
    with pytest.raises(DimensionError, match="agree"):
        load_observer("load", lifting, (0,), ("u",), batch, known.load[:-1], LoadSettings(current=2))
    with pytest.raises(DataError, match="0 of"):
        load_accuracy(known.load, 0 * known.load, DT)
