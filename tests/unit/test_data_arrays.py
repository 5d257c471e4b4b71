"""Arrays and long frames."""

from typing import Any

import numpy as np
import pytest
from scans import scan_digests

import kros
from kros.core.errors import DataError
from kros.data import Channel, EpisodeKey, Role, from_arrays, from_frame

CHANNELS = (Channel("x", Role.STATE, "m", measured=True), Channel("v", Role.STATE), Channel("u", Role.INPUT))


def values(seed: int, n: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 3))


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"b": [values(0)], "a": [values(1)]}, [("a", "default", "0"), ("b", "default", "0")]),
        ({"a": {"hot": [values(0)], "cold": [values(1)]}}, [("a", "cold", "0"), ("a", "hot", "0")]),
        (
            {EpisodeKey("a", "hot", e): values(i) for i, e in enumerate(("10", "9"))},
            [("a", "hot", "9"), ("a", "hot", "10")],
        ),
        ({7: [values(0)]}, [("7", "default", "0")]),
    ],
)
def test_shapes_of_data(data: Any, expected: list[tuple[str, str, str]]) -> None:
    assert from_arrays(data, CHANNELS, 0.1).episodes == tuple(EpisodeKey(*e) for e in expected)


def test_pairs_lists_and_column_order() -> None:
    whole = values(0)
    mixed = (CHANNELS[2], CHANNELS[0], CHANNELS[1])
    for population in (
        from_arrays({"a": [(whole[:, :2], whole[:, 2:])]}, CHANNELS, 0.1),
        from_arrays({"a": [(whole[:, :2], whole[:, 2])]}, CHANNELS, 0.1),
        from_arrays({"a": [whole.tolist()]}, CHANNELS, 0.1),
        from_arrays({"a": [whole[:, [2, 0, 1]]]}, mixed, 0.1),
    ):
        assert population.channels == CHANNELS
        np.testing.assert_array_equal(population.read(EpisodeKey("a", "default", "0")), whole)


NAMES: dict[str, Any] = {"states": ["x", "v"], "inputs": ["u"], "measured": ["x"], "sample_period_s": 0.1}


def test_names_in_place_of_channels() -> None:
    by_name = dict(zip("xvu", values(0).T, strict=True)) | {"temperature": values(1)[:, 0]}
    for data in ({"a": [by_name]}, {"a": {"default": [by_name]}}, {"a": [values(0)]}):
        population = kros.from_arrays(data, **NAMES)
        assert (population.states, population.inputs, population.measured) == (("x", "v"), ("u",), ("x",))
        np.testing.assert_array_equal(population.read(EpisodeKey("a", "default", "0")), values(0))
    rows = "units 1, episodes 1, conditions default, period 0.1 s, states x (1, measured), v (1), inputs u (1)"
    assert repr(population) == f"<Population: {rows}>"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measured": []}, r"measured should name some of the states .*, found \[\]"),
        ({"measured": ["u"]}, r"measured should name some of the states \['x', 'v'\], found \['u'\]"),
        ({"states": "x"}, r"states should be a list of names, found the text 'x'; write \['x'\]"),
        ({"states": []}, "give the names of states, inputs and measured, or channels"),
        ({"channels": CHANNELS}, "give the names of states, inputs and measured, or channels"),
        ({"inputs": ["w"]}, r"Episode 0 of unit a \(default\): channel 'w' is missing, found \['x', 'v', 'u'\]"),
        ({"sample_period_s": None}, "should be a number of seconds above zero, found None"),
    ],
)
def test_names_that_do_not_fit(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        kros.from_arrays({"a": [dict(zip("xvu", values(0).T, strict=True))]}, **{**NAMES, **changes})


@pytest.mark.parametrize(
    ("episode", "message"),
    [
        (values(0)[:, :2], r"Episode 0 of unit a \(default\): needs shape \(n_samples, 3\), found \(12, 2\)"),
        (values(0).T, r"found \(3, 12\); transpose"),
        (values(0)[:, 0], r"found \(12,\)"),
        ([["one", "two", "three"]], "found something else"),
        ((values(0)[:, :2], values(0)[:5, 2:]), "found something else"),
    ],
)
def test_arrays_that_do_not_fit(episode: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        from_arrays({"a": [episode]}, CHANNELS, 0.1)


def frame(**changes: Any) -> Any:
    pd = pytest.importorskip("pandas")
    rows = [
        pd.DataFrame(values(i), columns=["x", "v", "u"]).assign(unit=unit, episode=episode, t=np.arange(12) * 0.1)
        for i, (unit, episode) in enumerate([("a", 2), ("a", 10), ("b", 2)])
    ]
    return pd.concat(rows, ignore_index=True).assign(condition="hot").assign(**changes)


def test_frame_refuses() -> None:
    pd = pytest.importorskip("pandas")
    with pytest.raises(DataError, match="column 'v' is missing; the columns are"):
        from_frame(frame().drop(columns="v"), CHANNELS, time="t")
    with pytest.raises(DataError, match="one of time and sample_period_s"):
        from_frame(frame(), CHANNELS)
    with pytest.raises(DataError, match=r"column 'unit' should hold text or whole numbers, found 1\.5"):
        from_frame(frame(unit=1.5), CHANNELS, time="t")
    with pytest.raises(DataError, match=r"column 'x' should hold numbers"):
        from_frame(frame(x="wide"), CHANNELS, time="t")
    disordered = np.arange(12)[[0, 1, 2, 3, 4, 6, 5, 7, 8, 9, 10, 11]] * 0.1
    with pytest.raises(DataError, match=r"time should increase, found 0\.6 s at sample 5 and 0\.5 s at sample 6"):
        scan_digests(from_frame(frame(t=np.tile(disordered, 3)), CHANNELS, time="t"))
    twice = pd.concat([frame(), frame()], axis=1)
    with pytest.raises(DataError, match="column 'x' occurs 2 times; the columns are"):
        from_frame(twice, CHANNELS, time="t")
    with pytest.raises(DataError, match="found ndarray; use from_arrays"):
        from_frame(values(0), CHANNELS, time="t")
    with pytest.raises(DataError, match="population is empty"):
        from_frame(pd.DataFrame(columns=["unit", "x", "v", "u"]), CHANNELS, sample_period_s=0.1)


def test_names_that_are_alike_as_text_are_refused() -> None:
    with pytest.raises(DataError, match=r"Duplicate episodes: episode 0 of unit 1 \(default\);"):
        from_arrays({1: [values(0)], "1": [values(1)]}, CHANNELS, 0.1)
    assert from_arrays({1: [values(0)]}, CHANNELS, np.float32(0.5)).sample_period_s == 0.5


def test_masked_samples_are_missing() -> None:
    whole = np.ma.masked_array(values(0), np.arange(36).reshape(12, 3) == 13)  # v at sample 4
    for episode in (
        whole,
        [*whole],
        (whole[:, :2], whole[:, 2:]),
        {c.name: whole[:, i] for i, c in enumerate(CHANNELS)},
    ):
        population = from_arrays({"a": [episode]}, CHANNELS, 0.1)
        with pytest.raises(DataError, match="channel 'v' has 1 NaN at sample 4"):
            population.read(population.episodes[0])
