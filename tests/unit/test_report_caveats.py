"""What limits a report's statements is said: conditions that stand for units, sets smaller than the models' errors, scores that tell nothing."""

from __future__ import annotations

from typing import Any

import pytest

from kros.report.advice import advice
from kros.report.caveats import conditions_apart, small_set_text
from kros.report.sections.uncertainty import noise_text
from kros.report.summary import find_alerts
from kros.report.verdict import verdict

NAME = "koopman/worst_case_h2"


def metrics(recorded: dict[str, list[str]], **parts: Any) -> dict[str, Any]:
    conditions = sorted({c for of_unit in recorded.values() for c in of_unit})
    study = {"units": len(recorded), "conditions": conditions, "identify_on": conditions[0], "sample_period_s": 0.001, "deployed": NAME}
    units = [{"unit": u, "group": "population", "conditions": c, "status": "ok"} for u, c in recorded.items()]
    row = {"observer": NAME, "role": "off_nominal", "condition": conditions[0], "channel": "velocity", "rms": 1.0, "error_percent": 0.2}
    rows = [{**row, "unit": u} for u, c in recorded.items() if conditions[0] in c]
    return {"study": study, "units": units, "evaluation": rows, **parts}


def told(found: dict[str, Any]) -> str:
    return " ".join([*verdict(found), *advice(found), *(alert.text for alert in find_alerts(found))])


def uncertainty(peak_db: float, share: float = 0.01) -> dict[str, Any]:
    weight = {"cover_max": 0.9}
    entry = {"nominal": "a", "form": "additive", "peak_db": {"additive": peak_db}, "weight": weight}
    return {"koopman": {**entry, "noise_share": {"median": share, "at_peak": share, "peak_hz": 3.0}}}


def models(percent: float | None) -> dict[str, Any]:
    return {
        "koopman": {"freerun_error_percent": {"velocity": {"median": percent, "worst": percent}, "position": {"median": 0.1, "worst": 0.1}}}
    }


APART = {"a": ["cold"], "b": ["cold"], "c": ["hot"], "d": ["hot"], "e": ["hot"]}
TOGETHER = {unit: ["cold", "hot"] for unit in "abc"}


def test_units_that_stand_for_conditions_are_a_warning() -> None:
    text = told(metrics(APART, uncertainty=uncertainty(-20.0)))
    assert "Units and conditions are confounded" in text
    assert "about the 2 of 5 units that were recorded in “cold”" in text
    for claim in ("manufacturing", "every unit", "mean over the other units", "of one batch"):
        assert claim not in text
    assert conditions_apart(metrics(APART))


@pytest.mark.parametrize("recorded", [TOGETHER, {unit: ["cold"] for unit in "abc"}])
def test_units_that_share_their_conditions_are_none(recorded: dict[str, list[str]]) -> None:
    text = told(metrics(recorded, uncertainty=uncertainty(-20.0)))
    assert "confounded" not in text
    assert "manufacturing" not in text
    assert not conditions_apart(metrics(recorded))


def test_units_without_the_condition_that_is_identified_on_are_named_as_unknown() -> None:
    text = told(metrics({**TOGETHER, "d": ["hot"]}))
    assert "about the 3 of 4 units that were recorded in “cold”; about the others nothing was identified" in text
    assert "confounded" not in text


@pytest.mark.parametrize(
    ("peak_db", "percent", "warned"), [(-49.0, 20.0, True), (-20.0, 20.0, False), (-40.0, 4.9, False), (-40.0, 5.1, True)]
)
def test_a_set_far_smaller_than_the_models_errors_is_a_warning(peak_db: float, percent: float, warned: bool) -> None:
    """The rule: five times the largest residual, 10^(-49 / 20) = 0.35 %, against the worst channel of the middle unit."""
    found = metrics(TOGETHER, uncertainty=uncertainty(peak_db), models=models(percent))
    assert bool(small_set_text(found)) is warned
    assert ("far smaller than their own errors" in told(found)) is warned
    if peak_db == -49.0:
        assert "−49.0 dB, 0.35 %" in small_set_text(found)[0]
        assert "velocity by 20 %" in small_set_text(found)[0]


def test_nothing_is_compared_where_a_free_run_diverged_or_was_not_made() -> None:
    diverged = metrics(
        TOGETHER, uncertainty=uncertainty(-49.0), models={"koopman": {"freerun_error_percent": {"velocity": {"median": None}}}}
    )
    assert small_set_text(diverged) == small_set_text(metrics(TOGETHER, uncertainty=uncertainty(-49.0))) == []


def test_advice_about_recordings_speaks_of_units() -> None:
    for share in (0.01, 0.9):
        found = metrics(TOGETHER, uncertainty=uncertainty(-20.0, share))
        assert "manufacturing" not in " ".join([*advice(found), *noise_text(found["uncertainty"])])


def test_scores_that_tell_nothing_are_no_clean_bill() -> None:
    row = {"condition": "cold", "score": 0.0, "outlier": False, "needed_s": 120.0, "recorded_s": 20.0}
    rows = [
        {**row, "unit": "a", "status": "ok"},
        {**row, "unit": "b", "status": "not enough data"},
        {**row, "unit": "c", "status": "cannot tell"},
    ]
    text = told(metrics(TOGETHER, outliers=rows))
    assert "1 of 3 scores say nothing about their unit, as too little was recorded of it: b (cold)." in text
    assert "as the others are too few, or too unlike: c (cold)." in text
    assert "b (cold) needs about 120 s and has 20" in text
    assert "say nothing" not in told(metrics(TOGETHER, outliers=rows[:1]))
