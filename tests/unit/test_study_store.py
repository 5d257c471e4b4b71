"""Artefacts and results: what is in its place is whole, and as it was written."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from kros.core.artifacts import digest_of
from kros.core.errors import ConfigError
from kros.core.work import Results, Work, _read, stored
from kros.study.engine.store import Store


@dataclass(frozen=True)
class Pair:
    name: str
    values: np.ndarray


def square(x: float) -> float:
    return x * x


def written(folder, text: str, digest: str = digest_of("a")) -> Store:
    store = Store(folder)
    with store.drafting() as draft:
        path = draft.draft("deep", "a.txt")
        path.parent.mkdir(parents=True)
        path.write_text(text)
        draft.commit("read", digest, 0.0)
    return store


def test_another_artefact_of_a_stage_takes_the_place_of_the_first_which_can_come_back(tmp_path):
    written(tmp_path, "one")
    store = written(tmp_path, "two", digest_of("b"))
    assert (tmp_path / "deep" / "a.txt").read_text() == "two"
    store.add("read", store.stored(digest_of("a")))
    assert (tmp_path / "deep" / "a.txt").read_text() == "one"
    store.sweep()
    assert store.stored(digest_of("b")) is None


def test_a_run_inside_is_among_the_files_of_its_stage_and_shares_the_store(tmp_path):
    store = Store(tmp_path)
    with store.drafting() as draft:
        inside = draft.nested("left_out", "0")
        with inside.drafting() as own:
            own.draft().mkdir()
            own.draft("b.txt").write_text("text")
            own.commit("identify", digest_of("inside"), 0.0)
        draft.commit("left_out", digest_of("whole"), 0.0)
    assert store.files() == {"left_out/0/b.txt", "left_out/0/manifest.json"}
    store.sweep()
    assert store.stored(digest_of("inside")) is not None
    store.drop("left_out")
    assert store.files() == frozenset()
    assert not (tmp_path / "left_out").exists()


def test_where_files_cannot_be_linked_they_are_copied_with_their_times(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError("no links here")

    monkeypatch.setattr("os.link", refuse)
    store = written(tmp_path, "one")
    file = tmp_path / "deep" / "a.txt"
    assert file.stat().st_nlink == 1
    assert file.stat().st_mtime_ns == store.manifest.get("read").files["deep/a.txt"][2]
    monkeypatch.setattr("kros.report.manifest.file_digest", lambda path: pytest.fail("was read again"))
    store.add("read", store.stored(digest_of("a")))


@pytest.mark.parametrize("name", ["deep", "deep/a.txt/b"])
def test_what_is_in_the_place_of_a_result_is_named(tmp_path, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(ConfigError, match="is in the place of a result; move it away"):
        written(tmp_path, "one")
    assert (tmp_path / name).read_text() == "mine"


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (None, None),
        (list[int | float | str | bool], [1, 2.5, "text", True, 1e-300]),
        (tuple[float, dict[str, int | None]], (float("inf"), {"is": 3, "shape": None})),
        (list[np.ndarray], [np.arange(6.0).reshape(2, 3), np.zeros((0, 2)), np.array([True, False]), np.array(2.0)]),
        (Pair, Pair("a", np.array([[0.1, -0.0], [np.nan, np.inf]]))),
    ],
    ids=range(5),
)
def test_results_come_back_bit_by_bit(tmp_path, kind, value):
    store, (one, other) = partial(stored, lambda task: task), (tmp_path / name for name in "ab")
    store((one, value))
    again = _read(one, kind, lambda result: True)
    store((other, again))
    assert one.read_bytes() == other.read_bytes()
    assert repr(again) == repr(value)


def test_results_of_a_map_that_was_interrupted_are_there(tmp_path):
    work = Work(results=Results(tmp_path, "source"))
    assert next(work.recall("square", square, [2.0, 3.0], ["a", "b"])) == 4.0
    assert list(work.recall("square", square, [0.0, 3.0], ["a", "b"])) == [4.0, 9.0]


def test_results_are_computed_once_and_what_is_damaged_again(tmp_path):
    results = Results(tmp_path, "source")
    work = Work(results=results)
    known = ["a", None, "b"]
    assert list(work.recall("square", square, [2.0, 3.0, 4.0], known)) == [4.0, 9.0, 16.0]
    assert {path.stem for path in tmp_path.iterdir()} == results.used
    assert list(work.recall("square", square, [0.0, 3.0, 0.0], known)) == [4.0, 9.0, 16.0]
    assert list(Work(results=Results(tmp_path, "other")).recall("square", square, [5.0], ["a"])) == [25.0]
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:-9])
    assert list(work.recall("square", square, [5.0, 3.0, 6.0], known)) == [25.0, 9.0, 36.0]
