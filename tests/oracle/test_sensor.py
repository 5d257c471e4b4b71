"""The declared sensor: what it does to recordings, where it is refused, and that it stays with the observer."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from batches import batch_of

from kros.core.errors import ConfigError
from kros.core.lti import gain
from kros.design.synthesize import measurement_noise
from kros.evaluate.sensor import as_arriving, as_shown
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, Sensor
from kros.observer.sensor import require_measured
from kros.observer.simulate import run_observers
from kros.observer.units import in_sizes
from kros.study.config import validate_config
from kros.synthesis.result import Injection

STATES = ("position", "velocity")
DT = 0.001


def recorded(n_samples=20_000, batch=3):
    t = np.arange(n_samples)[:, None] * DT
    phase = np.arange(batch)
    x = np.stack([np.sin(3 * t + phase), 3 * np.cos(3 * t + phase)], axis=-1)
    return batch_of(x, np.zeros((n_samples, batch, 1)), DT)


def shown(**sensor):
    batch = recorded()
    found = as_shown(batch, {"position": Sensor(**sensor)}, STATES)
    np.testing.assert_array_equal(found.states, batch.states)
    return batch.states[..., 0], found.measurements((0,))[..., 0]


def test_nothing_declared_shows_the_recordings():
    batch = recorded(100)
    assert as_shown(batch, {}, STATES) is batch
    assert as_shown(batch, {"position": Sensor()}, STATES) is batch
    np.testing.assert_array_equal(batch.measurements((1,)), batch.states[..., [1]])


def test_what_is_shown_has_the_declared_statistics():
    truth, y = shown(noise=1e-3, bias=0.2)
    assert np.mean(y - truth) == pytest.approx(0.2, abs=2e-5)
    assert np.std(y - truth) == pytest.approx(1e-3, rel=0.02)
    truth, y = shown(resolution=1e-2)
    assert np.abs(y - truth).max() <= 0.5e-2 + 1e-12
    np.testing.assert_allclose(y / 1e-2, np.rint(y / 1e-2), atol=1e-9)
    truth, y = shown(delay_samples=2)
    np.testing.assert_array_equal(y[2:], truth[:-2])
    np.testing.assert_array_equal(y[:2], truth[[0, 0]])
    truth, y = shown(dropout=0.05)
    lost = np.isnan(y)
    assert not lost[0].any()
    assert lost.mean() == pytest.approx(0.05, abs=0.003)
    np.testing.assert_array_equal(y[~lost], truth[~lost])


def test_variance_is_that_of_what_is_shown():
    own = Sensor(noise=2e-3, resolution=1e-2, jitter_samples=3.0)
    truth, y = shown(**own.model_dump())
    step = np.sqrt(np.mean(np.diff(truth, axis=0) ** 2))
    assert np.mean((y - truth) ** 2) == pytest.approx(own.variance(step), rel=0.03)


def test_draws_belong_to_an_episode():
    batch, sensor = recorded(200), {"position": Sensor(noise=1e-3, dropout=0.2)}
    whole = as_shown(batch, sensor, STATES)
    part = as_shown(batch.take([2, 0]).head(50), sensor, STATES)
    np.testing.assert_array_equal(part.measurements((0,)), whole.take([2, 0]).head(50).measurements((0,)))
    there = whole.measurements((0,), arrived=False)
    assert np.isfinite(there).all()
    other = as_shown(batch, sensor, STATES, seed=1).measurements((0,), arrived=False)
    assert not np.allclose(other, there)


def test_what_syntheses_assume_is_the_declared_noise_and_the_coarser_resolution():
    identified: Any = SimpleNamespace(facts=SimpleNamespace(resolution={"position": 1e-3, "force": 2e-3}))
    models: Any = SimpleNamespace(measured=(0, 1), lifting=Lifting(("position", "force", "velocity")))
    told = {
        "position": Sensor(noise=1e-3, resolution=1e-2, delay_samples=1),
        "force": Sensor(resolution=1e-3, bias=9.0),
    }
    np.testing.assert_allclose(
        measurement_noise(identified, models, told), [np.sqrt(1e-6 + 1e-4 / 12), 2e-3 / np.sqrt(12)], rtol=1e-12
    )
    np.testing.assert_allclose(
        measurement_noise(identified, models, {}), np.array([1e-3, 2e-3]) / np.sqrt(12), rtol=1e-12
    )


def test_recordings_arrive_late_at_an_observer_that_was_told_so_and_nothing_is_added():
    batch = recorded(50)
    y = as_arriving(
        batch, {"position": Sensor(noise=1.0, bias=3.0, delay_samples=2, dropout=0.5)}, STATES
    ).measurements((0,))
    np.testing.assert_array_equal(y[2:], batch.measurements((0,))[:-2])
    assert as_arriving(batch, {"position": Sensor(noise=1.0)}, STATES) is batch


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        ({"velocity": {"noise": 1e-3}}, "velocity should be among the states that are measured"),
        ({"position": {"noise": -1.0}}, "sensor.position.noise"),
        ({"position": {"noise": float("inf")}}, r"noise: input should be at most 1e\+50 in size, found inf"),
        ({"position": {"delay_samples": True}}, "delay_samples: input should not be true or false, found True"),
        ({"position": {"dropout": 1.0}}, "less than 1"),
        (
            {"position": {"nois": 1.0}},
            r"unknown key; did you mean 'noise'\? known are noise, resolution, bias, delay_samples, jitter_samples, dropout",
        ),
    ],
)
def test_what_cannot_be_a_sensor_is_refused(sensor, reason, tmp_path):
    with pytest.raises(ConfigError, match=reason):
        require_measured(validate_config({"data": {"source": "x"}, "sensor": sensor}, tmp_path).sensor, ("position",))


def test_channels_late_by_different_numbers_are_refused():
    with pytest.raises(ConfigError, match="the same for all measured states"):
        require_measured({"a": Sensor(delay_samples=1)}, ("a", "b"))


def observer(correction=0.2, delay=0):
    A, B = np.array([[1.0, DT], [0.0, 0.99]]), np.array([[0.0], [DT]])
    sensor, K = {"position": Sensor(noise=1e-3, delay_samples=delay)}, gain([[correction], [1.0]], DT)
    return Observer(
        "o", Lifting(STATES), A, B, (0,), ("u",), K, Injection.STATE, DT, runtime=Runtime(delay=delay), sensor=sensor
    )


def test_an_observer_keeps_what_it_was_told(tmp_path):
    observer(delay=1).save(tmp_path / "o.json")
    again = Observer.load(tmp_path / "o.json")
    assert again.sensor == observer(delay=1).sensor
    assert again.runtime.delay == 1
    divided = in_sizes(again, {"position": 4.0})
    assert divided.sensor["position"].noise == pytest.approx(2.5e-4)
    assert in_sizes(divided, {}).sensor["position"].noise == pytest.approx(1e-3)


def test_observers_of_late_measurements_run_side_by_side_as_they_do_alone():
    batch, several = recorded(300), [observer(0.1, 2), observer(0.3, 2)]
    y = as_shown(batch, several[0].sensor, STATES).measurements((0,))
    together = run_observers(several, y, batch.inputs)
    for found, own in zip(together, several, strict=True):
        np.testing.assert_allclose(found, own.run(y, batch.inputs), rtol=1e-12, atol=1e-12)
