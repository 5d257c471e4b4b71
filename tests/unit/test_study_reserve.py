"""What errors on units in reserve say about the next unit."""

from __future__ import annotations

from typing import Any

import pytest

from kros.study.stages.left_out import bounds_of


def rows(percent: dict[str, float | None], channel: str = "velocity") -> list[dict[str, Any]]:
    return [
        {"unit": unit, "channel": channel, "error_percent": error, "rms": error and error / 10}
        for unit, error in percent.items()
    ]


def test_an_estimate_that_diverged_on_a_unit_of_the_study_is_no_scale() -> None:
    """Its error is null where it is stored; a channel with such a unit has no bound, others have theirs."""
    known = rows({"c": 3.0, "d": None}) + rows({"c": 1.0, "d": 1.0}, "current")
    reserve = rows({"a": 1.0, "b": 2.0}) + rows({"a": 0.5, "b": 0.25}, "current")
    found = bounds_of(reserve, known, ["velocity", "current"], 0.6)
    assert found["bounds"]["velocity"] == {"error_percent": None, "rms": None}
    assert found["bounds"]["current"]["error_percent"] == pytest.approx(0.5)
    assert "no finite error" in bounds_of(rows({"a": 1.0}), rows({"c": None}), ["velocity"], 0.6)["reason"]


def test_a_reserve_without_a_bound_says_why() -> None:
    assert "needs 19" in bounds_of(rows({"a": 1.0}), rows({"c": 1.0}), ["velocity"], 0.95)["reason"]
    lost = rows({"a": float("inf"), "b": 1.0})
    assert "diverges on too many" in bounds_of(lost, rows({"c": 1.0}), ["velocity"], 0.6)["reason"]
    one = rows({"b": 1.0})
    assert "needs 2" in bounds_of(one, rows({"c": 1.0}), ["velocity"], 0.6)["reason"]
    assert "cannot be calibrated" in bounds_of(one, rows({"c": 1.0}), ["velocity"], 0.6, lost=1)["reason"]
