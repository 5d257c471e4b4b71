"""Preparation steps against hand-made answers and analytic signals."""

from typing import Any

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError
from kros.data import Channel, EpisodeKey, Population, Role, from_arrays, from_frame, prepare, steps
from kros.data.prepare import parse_steps, with_gaps
from kros.data.recording import NonFiniteError
from kros.data.steps import Resample, lowpass

KEY = EpisodeKey("a", "default", "0")
CHANNELS = (Channel("x", Role.STATE, "deg", measured=True), Channel("y", Role.STATE), Channel("u", Role.INPUT))


def population(values: np.ndarray, period: float = 0.1) -> Population:
    return from_arrays({KEY: values}, CHANNELS, period)


def counting(n: int = 10) -> np.ndarray:
    k = np.arange(n, dtype=float)
    return np.column_stack([k, 100 + k, 200 + k])


@pytest.mark.parametrize("lag", [0, 1, 3, -1, -3])
def test_shift_brings_lagging_channels_back(lag: int) -> None:
    aligned = counting(20)
    late = aligned.copy()
    late[:, 2] -= lag  # the value of sample k is recorded at k + lag
    result = prepare(population(late), [steps.Shift(("u",), lag)]).read(KEY)
    start = max(0, -lag)
    np.testing.assert_array_equal(result, aligned[start : start + 20 - abs(lag)])


def test_offset_is_the_mean_difference_over_its_window() -> None:
    values = counting()
    result = prepare(population(values), [steps.Offset("x", "u", 2, 4)]).read(KEY)
    np.testing.assert_allclose(result - values, np.tile([200.0, 0, 0], (10, 1)))
    with pytest.raises(DataError, match="the offset needs 11 samples, found 10"):
        prepare(population(values), [steps.Offset("x", "u", 2, 11)]).read(KEY)


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        (steps.Trim(3), range(3, 10)),
        (steps.Trim(0, 4), range(4)),
        (steps.Trim(2, None, 3), range(2, 7)),
        (steps.Trim(1, 9, 4), range(1, 6)),
    ],
)
def test_trim(step: steps.Trim, expected: range) -> None:
    np.testing.assert_array_equal(prepare(population(counting()), [step]).read(KEY)[:, 0], list(expected))


def test_steps_run_in_order_and_leave_the_source_alone() -> None:
    original = counting()
    source = population(original)
    both = prepare(prepare(source, [steps.Trim(start=1)]), [steps.Trim(start=2), steps.Scale(("x",), 2.0)])
    assert both.read(KEY)[0, 0] == 6.0
    np.testing.assert_array_equal(source.read(KEY), counting())
    np.testing.assert_array_equal(original, counting())


def uneven(period: float, n: int, seed: int) -> np.ndarray:
    """Increasing times whose steps vary by a third."""
    return np.cumsum(period * (1 + 0.33 * np.random.default_rng(seed).uniform(-1, 1, n)))


def test_resampling_straight_lines_is_exact_at_any_rate() -> None:
    time = uneven(0.01, 500, 1)
    lines = np.column_stack([3 * time + 1, -time, 0 * time])
    for period in (0.004, 0.01, 0.025, 0.1):
        result = Resample(period).on_grid(time, lines, 0.01)
        grid = time[0] + period * np.arange(len(result))
        assert grid[-1] <= time[-1] + 1e-9 < grid[-1] + period + 1e-6
        np.testing.assert_allclose(result, np.column_stack([3 * grid + 1, -grid, 0 * grid]), atol=1e-12)


def test_resampling_keeps_slow_and_removes_what_would_alias() -> None:
    time = np.arange(0, 20, 0.001)
    slow, fast = np.sin(2 * np.pi * 3 * time), np.sin(2 * np.pi * 97 * time)  # 97 Hz aliases to 3 Hz at 50 Hz
    result = Resample(0.02).on_grid(time, np.column_stack([slow, fast]), 0.001)
    middle = slice(50, -50)
    np.testing.assert_allclose(
        result[middle, 0], np.sin(2 * np.pi * 3 * 0.02 * np.arange(len(result)))[middle], atol=5e-3
    )
    assert np.abs(result[middle, 1]).max() < 5e-3
    assert np.abs(fast[::20]).max() > 0.9  # thinning alone would have kept it


def test_lowpass_gain_against_theory() -> None:
    k = np.arange(4000)
    for frequency, gain in [(0.0, 1.0), (0.05, 1.0), (0.1, 0.5), (0.2, 0.0)]:
        signal = np.cos(2 * np.pi * frequency * k)[:, None]
        out = lowpass(signal, 0.1)[500:-500, 0]
        np.testing.assert_allclose(out, gain * signal[500:-500, 0], atol=6e-3)


def frame_population(time: np.ndarray) -> Population:
    pd = pytest.importorskip("pandas")
    rng = np.random.default_rng(0)
    frame = pd.DataFrame(
        {"unit": "a", "t": time, "x": np.sin(time), "y": np.cos(time), "u": rng.standard_normal(len(time))}
    )
    return from_frame(frame, CHANNELS, time="t")


def test_resample_declared_later_lifts_the_error_of_uneven_time() -> None:
    source = frame_population(uneven(0.01, 400, 2))
    with pytest.raises(DataError, match="uneven time"):
        source.read(KEY)
    even = prepare(source, [steps.Resample(0.01)])
    assert even.sample_period_s == 0.01
    grid = uneven(0.01, 400, 2)[0] + 0.01 * np.arange(len(even.read(KEY)))
    np.testing.assert_allclose(even.read(KEY)[:, 0], np.sin(grid), atol=1e-4)


def test_resample_bridges_samples_that_hold_nan_but_not_those_that_may_be_missing() -> None:
    time = 0.01 * np.arange(400)
    values = np.column_stack([np.sin(time), np.cos(time), time])
    values[[7, 100, 101], [0, 1, 2]] = np.nan
    holes = prepare(from_arrays({KEY: values}, CHANNELS, 0.01), [steps.Resample(0.01)])
    np.testing.assert_allclose(holes.read(KEY)[:, 0], np.sin(time), atol=1e-4)
    assert np.isnan(with_gaps(holes).read(KEY)[7, 0])
    values[:, 1] = np.nan
    with pytest.raises(NonFiniteError, match="NaN"):  # nothing to bridge: on_nan = "drop_episode" finds it
        prepare(from_arrays({KEY: values}, CHANNELS, 0.01), [steps.Resample(0.01)]).read(KEY)


def test_resample_takes_the_longest_stretch_without_gaps_and_refuses_time_that_runs_backwards() -> None:
    gap = np.arange(400) * 0.01
    gap[12:] += 0.2
    gap[300:] += 0.5
    stretch = prepare(frame_population(gap), [steps.Resample(0.01)]).read(KEY)
    np.testing.assert_allclose(stretch[:, 0], np.sin(gap[12:300]), atol=1e-12)
    assert len(prepare(frame_population(gap), [steps.Resample(0.01, max_gap_s=1.0)]).read(KEY)) == 470
    back = np.arange(400) * 0.01
    back[200] = back[199]
    with pytest.raises(DataError, match=r"time should increase, found 1\.99 s at sample 199 and 1\.99 s at sample 200"):
        prepare(frame_population(back), [steps.Resample(0.01)]).read(KEY)


def test_differentiate_adds_a_state_with_the_derivative() -> None:
    time = np.arange(0, 20, 0.01)
    values = np.column_stack([np.sin(2 * time), np.cos(time), time])
    moved = prepare(population(values, 0.01), [steps.Differentiate("x", "v", cutoff_hz=5.0, unit="deg/s")])
    assert moved.states == ("x", "y", "v")
    assert moved.inputs == ("u",)
    result = moved.read(KEY)
    np.testing.assert_allclose(result[100:-100, 2], 2 * np.cos(2 * time)[100:-100], atol=1e-2)
    np.testing.assert_array_equal(result[:, 3], time)
    true = prepare(population(values, 0.01), [steps.Differentiate("x", "v", 5.0, "deg/s", of="y")])
    assert [(c.name, c.of) for c in true.truths] == [("v", "y")]
    of_state, truth = true.read_with_truths(KEY)
    np.testing.assert_array_equal(truth[:, 0], result[:, 2])
    np.testing.assert_array_equal(of_state, values)


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (steps.Scale(("z",), 1.0), r"'scale' asks for channel 'z'; there are \['x', 'y', 'u'\]"),
        (steps.Shift(("z",), 1), "'shift' asks for channel 'z'"),
        (steps.Offset("x", "z", 0, 1), "'offset' asks for channel 'z'"),
        (steps.Offset("x", "u", 4, 4), "0 <= start < stop, found start = 4, stop = 4"),
        (steps.Trim(start=-1), "0 <= start < stop and tail >= 0"),
        (steps.Resample(0.0), r"period_s > 0, found 0\.0"),
    ],
)
def test_steps_that_do_not_fit_are_refused_before_reading(step: steps.Step, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        prepare(population(counting()), [step])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"step": "smooth"}, r"data\.prepare\[0\]: step should be one of .*'trim'.*found 'smooth'"),
        ({"start": 3}, "found None"),
        ("trim", "found None"),
        ({"step": "scale", "channels": ["x", 3], "factor": 2}, r"channels\.1: input should be a valid string, found 3"),
        (
            {"step": "trim", "begin": 3},
            r"\(step 'trim'\): begin: unexpected keyword argument, found 3; the keys are start, stop, tail",
        ),
        ({"step": "trim", "start": 1.5}, r"start: input should be a valid integer.*, found 1\.5"),
        ({"step": "trim", "stop": "end"}, "stop: input should be a valid integer.*, found 'end'"),
        ({"step": "scale", "factor": 2}, "channels: field required"),
        ({"step": "scale", "channels": "x", "factor": 2}, "channels: input should be a valid tuple, found 'x'"),
    ],
)
def test_steps_from_toml_refuse(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_steps([table])
