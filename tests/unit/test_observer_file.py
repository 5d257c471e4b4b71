"""The file of an observer: what is wrong with it is said, and nothing wrong is run."""

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.errors import DataError, DimensionError
from kros.core.lti import StateSpace, gain
from kros.lifting import Lifting
from kros.observer import Observer, Runtime
from kros.observer.filter_bank import FilterBank
from kros.synthesis.result import Injection

DIAGONAL = np.diag([0.9, 0.8, 0.1])


def observer(A: Any = DIAGONAL) -> Observer:
    lifting = Lifting(("position", "velocity"), ("sin(3*position + phase)",), ("phase",))
    K = StateSpace(np.eye(2) / 2, np.ones((2, 1)), np.ones((3, 2)), np.ones((3, 1)), 0.01)
    runtime = Runtime(delay=1, lower=np.array([-1.0, -np.inf]), start=np.array([0.0, 0.5]))
    model = A, np.ones((3, 1)), (0,), ("torque",)
    return Observer("o", lifting, *model, K, Injection.STATE, 0.01, {"phase": 0.3}, runtime=runtime)


def changed(path: Path, change: Callable[[dict[str, Any]], Any], checksum: bool = False) -> Path:
    """Change a file as a person would who removes the checksum, or as a fault would that does not."""
    observer().save(path)
    content = json.loads(path.read_text())
    if not checksum:
        del content["checksum"]
    change(content)
    path.write_text(json.dumps(content))
    return path


def put(*place: Any) -> Callable[[dict[str, Any]], None]:
    """Put the last argument where the others lead; nothing behind them removes it."""
    *keys, last, value = place

    def change(content: Any) -> None:
        for key in keys:
            content = content[key]
        if value is DEL:
            del content[last]
        else:
            content[last] = value

    return change


DEL = object()


def test_what_was_saved_is_what_runs(tmp_path: Path) -> None:
    observer().save(str(tmp_path / "o.json"))
    again = Observer.load(str(tmp_path / "o.json"))
    y, u = np.random.default_rng(0).normal(size=(50, 1, 1)), np.ones((50, 1, 1))
    np.testing.assert_array_equal(again.run(y, u), observer().run(y, u))


def test_a_file_without_checksum_is_validated_and_said_to_have_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        Observer.load(changed(tmp_path / "o.json", put("model", "A", 0, 0, 0.5)))
    assert "no checksum" in caplog.text


@pytest.mark.parametrize(
    "change", [put("model", "A", 0, 0, 0.5), put("name", "p"), put("sample_period_s", 0.02), put("runtime", DEL)]
)
def test_a_changed_file_does_not_fit_its_checksum(tmp_path: Path, change: Callable[[Any], None]) -> None:
    with pytest.raises(DataError, match=r"o\.json: the content does not fit its checksum"):
        Observer.load(changed(tmp_path / "o.json", change, checksum=True))


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (put("model", "A", 0, 0, None), r"model\.A\.0\.0: input should be a valid number, found None"),
        (put("model", "A", 1, 2, "1.5"), r"model\.A\.1\.2: input should be a valid number, found '1\.5'"),
        (put("model", "A", 1, [1.0, 2.0]), r"model\.A: .*all rows should have the same length, found \[2, 3\]"),
        (put("model", "A", [[0.5]]), r"the model A should have shape \(3, 3\), found \(1, 1\)"),
        (put("model", "E", [[0.5]]), "model.E: extra inputs are not permitted"),
        (put("model", DEL), "model: field required"),
        (put("controller", "C", DEL), "controller.C: field required"),
        (put("measured", [2]), "measured should list different states by number, 0 to 1"),
        (put("measured", [0, 0]), "measured"),
        (put("sample_period_s", 0), "sample_period_s: input should be greater than 0"),
        (put("inputs", ["position"]), "the names of states, inputs and parameters should differ, found position"),
        (put("inputs", [""]), r"inputs.0: string should have at least 1 character"),
        (put("lifting", ["sin(load)"]), "load"),
        (put("parameters", "phase", "x"), r"parameters\.phase: input should be a valid number"),
        (put("injection", "both"), "both"),
        (put("runtime", "delay", "1"), r"runtime\.delay"),
        (put("runtime", "lower", ["0", None]), r"runtime\.lower"),
        (put("runtime", "delai", 1), "runtime.delai: extra inputs are not permitted"),
        (put("about", 5), "about: input should be a valid dictionary"),
        (put("name", ""), "name: string should have"),
        (put("kind", "model"), "not an observer file"),
        (put("schema", 2), "not an observer file"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, change: Callable[[Any], None], found: str) -> None:
    with pytest.raises(DataError, match=found):
        Observer.load(changed(tmp_path / "o.json", change))


def test_an_observer_that_nobody_could_read_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"model\.A\.0\.0: input should be a valid number"):
        observer(A=np.diag([np.nan, 0.8, 0.1])).save(tmp_path / "o.json")
    assert not (tmp_path / "o.json").exists()


def filters(**changes: Any) -> Observer:
    """A filter bank of one filter, and no filter of inputs."""
    states = ("position", "filter_1", "position_error", "position_from_inputs")
    lifting = Lifting(states, (), (), ("torque",), ("1",))
    ones = dict.fromkeys(("half", "reach", "noise", "rest", "gate", "opening", "deviations", "persistence"), np.ones(1))
    bank = {"filters": 1, "start": np.ones((4, 6)), "recovery": np.array([0.9]), "doubt": np.eye(1), **ones}
    none, made = gain(np.zeros((4, 1)), 0.01), FilterBank(**bank | changes)
    return Observer(
        "f", lifting, 0.5 * np.eye(4), np.ones((4, 2)), (0,), ("torque",), none, Injection.STATE, 0.01, bank=made
    )


@pytest.mark.parametrize(
    ("changes", "error", "match"),
    [
        ({"recovery": np.array([1.5])}, DataError, "between 0 and 1"),
        ({"recovery": np.ones(2)}, DimensionError, "recovery"),
        ({"half": np.zeros(1)}, DataError, "half should be positive"),
        ({"start": np.ones((2, 5))}, DimensionError, "start"),
        ({"filters": 4, "doubt": np.eye(4)}, DimensionError, "at most 1 filters of measurements; found .* 4 filters"),
    ],
)
def test_a_filter_bank_that_does_not_fit_is_refused(
    changes: dict[str, Any], error: type[Exception], match: str
) -> None:
    with pytest.raises(error, match=match):
        filters(**changes)


def test_a_filter_bank_has_no_correction() -> None:
    with pytest.raises(DimensionError, match="has no correction"):
        replace(filters(), controller=gain(np.ones((4, 1)), 0.01))
