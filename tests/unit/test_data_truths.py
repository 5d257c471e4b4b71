"""What states really were stays beside the recordings: kept by readers and writers, seen by no model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kros.core.artifacts import read_json
from kros.core.errors import DataError
from kros.data import Channel, EpisodeBatch, Population, Role, from_arrays, prepare, read, steps, write_parquet
from kros.data.prepare import scale_population
from kros.data.readers.parquet import read_parquet
from kros.identify.survey import survey

CHANNELS = (Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE), Channel("u", Role.INPUT))
TRUTH = Channel("v_true", Role.TRUTH, of="v")


def recorded(channels: tuple[Channel, ...] = (TRUTH, *CHANNELS), seed: int = 3) -> Population:
    """Two units with two episodes; the truth is the first column of the arrays."""
    rng = np.random.default_rng(seed)
    data = {unit: [rng.standard_normal((40 + e, 4)) for e in range(2)] for unit in "ab"}
    return from_arrays(
        {u: [e[:, 4 - len(channels) :] for e in episodes] for u, episodes in data.items()}, channels, 0.1
    )


def test_a_truth_is_no_channel() -> None:
    judged, plain = recorded(), recorded(CHANNELS)
    assert judged.channels == plain.channels == CHANNELS
    assert (judged.truths, judged.true_states) == ((TRUTH,), (1,))
    assert repr(judged) == f"{repr(plain)[:-1]}, truths {TRUTH.label}>"
    for key in plain.episodes:
        np.testing.assert_array_equal(judged.read(key), plain.read(key))
    whole, same = EpisodeBatch.read(judged, judged.episodes, truths=True), EpisodeBatch.read(plain, plain.episodes)
    assert whole.states.strides == same.states.strides
    assert (same.truths, EpisodeBatch.read(judged, judged.episodes).truths) == (None, None)
    np.testing.assert_array_equal(whole.inputs, same.inputs)
    for i, key in enumerate(judged.episodes):
        expected = judged.source(key)[:, 3:]
        np.testing.assert_array_equal(whole.truths[: len(expected), i], expected)
        np.testing.assert_array_equal(whole.take([i]).head(7).truths[:, 0], expected[:7])


def test_truths_are_written_prepared_and_scaled_with_their_states(tmp_path: Path) -> None:
    judged = prepare(recorded(), [steps.Trim(start=3), steps.Scale(("v", "v_true"), 2.0, "mm/s")]).select(["b"])
    for name, population in (("judged", judged), ("plain", prepare(recorded(CHANNELS), [steps.Trim(start=3)]))):
        write_parquet(population, tmp_path / name)
    again = read_parquet(tmp_path / "judged")
    assert again.truths == (Channel("v_true", Role.TRUTH, "mm/s", of="v"),)
    scaled = scale_population(again, {"v": 4.0})
    assert [t.unit for t in scaled.truths] == [""]
    for key in judged.episodes:
        np.testing.assert_array_equal(again.source(key), judged.source(key))
        np.testing.assert_allclose(scaled.source(key) * [1, 4, 1, 4], again.source(key))
        np.testing.assert_array_equal(again.read_with_truths(key)[1][:, 0], 2 * recorded().source(key)[3:, 3])
    assert read_json(tmp_path / "plain" / "population.json")["truths"] == []
    assert survey(again)[1] == survey(judged)[1]


def test_a_csv_mapping_declares_a_truth(tmp_path: Path) -> None:
    rng, rows = np.random.default_rng(1), {}
    for unit in "ab":
        rows[unit] = rng.standard_normal((20, 3))
        lines = [",".join(map(repr, row)) for row in rows[unit].tolist()]
        (tmp_path / f"{unit}.csv").write_text("\n".join(["x,w,u", *lines]))
    channel = [
        {"name": "x_true", "role": "truth", "of": "x", "column": "w"},
        {"name": "u", "role": "input", "column": "u"},
        {"name": "x", "role": "state", "column": "x", "measured": True},
    ]
    found = read(tmp_path, "csv", {"files": r"(?P<unit>\w)\.csv", "sample_period_s": 0.1, "channel": channel})
    assert (found.states, found.inputs, found.true_states) == (("x",), ("u",), (0,))
    np.testing.assert_array_equal(found.read_with_truths(found.episodes[0])[1], rows["a"][:, [1]])


@pytest.mark.parametrize(
    "wrong",
    [
        (Channel("v_true", Role.TRUTH),),
        (Channel("v_true", Role.TRUTH, of="u"),),
        (Channel("v_true", Role.STATE, of="v"),),
        (TRUTH, Channel("v_other", Role.TRUTH, of="v")),
    ],
)
def test_a_truth_is_that_of_one_state(wrong: tuple[Channel, ...]) -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(DataError, match="with `of` which state"):
        from_arrays({"a": [rng.standard_normal((9, 3 + len(wrong)))]}, (*CHANNELS, *wrong), 0.1)
