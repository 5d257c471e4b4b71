"""The head of the report: verdict, reasons, numbers, certificates, and what differs between runs; for metrics made by hand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from kros.report.compare import compared, differences
from kros.report.facts import Facts
from kros.report.sections.errors import errors
from kros.report.verdict import Status, judge
from kros.study.commands.summary import ranking
from kros.study.pipeline import RunResult

NAME = "koopman/estimator"


def row(observer: str, percent: float | None, unit: str = "b", channel: str = "velocity") -> dict[str, Any]:
    found = {"observer": observer, "unit": unit, "role": "off_nominal", "condition": "default", "channel": channel}
    return {**found, "error_percent": percent, "rms": percent and percent / 50}


def metrics(**parts: Any) -> dict[str, Any]:
    study = {"units": 3, "conditions": ["default"], "identify_on": "default", "sample_period_s": 0.002}
    study |= {"deployed": NAME, "measured": ["angle"], "channels": {"angle": "rad", "velocity": "rad/s"}}
    certified = {"status": "certified", "relift_certified": True, "relift_gain": 2.0}
    observers = {NAME: certified, "linear/worst_case_h2": {"status": "certified"}}
    study |= parts.pop("study", {})
    evaluation = [row(NAME, 0.2), row("koopman/open_loop", 0.9)]
    return {"study": study, "observers": observers, "evaluation": evaluation, **parts}


OPEN_LOOP = "koopman/open_loop"
BETTER_IN_ONE = [
    row(NAME, 0.2),
    row(OPEN_LOOP, 0.9),
    row(NAME, 6.2, "b", "current"),
    row(OPEN_LOOP, 6.1, "b", "current"),
]
RIVAL = [row(NAME, 0.2), row("linear/residual_h2", 0.1)]
LOSSES = {NAME: {"loss_error_percent": 38.0}, "linear/residual_h2": {"loss_error_percent": None}}
UNCERTIFIED = {NAME: {"relift_certified": False}, "linear/mixed": {}}
FLAGGED = {"unit": "b", "condition": "default", "score": 9.0, "outlier": True}
OPEN = {**FLAGGED, "outlier": False, "status": "cannot tell"}
BOUND = {"set_certified": True, "set_bound": {"velocity": 0.003}, "relift_certified": True, "relift_gain": 2.0}


CHECK: list[tuple[dict[str, Any], str, str]] = [
    ({"outliers": [FLAGGED]}, "units", "Flagged as not belonging to the batch: b"),
    ({"outliers": [OPEN]}, "units", "No outlier score is conclusive (1 of 1)"),
    ({"study": {"alerts": ["a stuck sensor"]}}, "recordings", "a stuck sensor"),
    ({"observers": UNCERTIFIED}, "certificates", "No certificate at run time"),
    ({"observers": {NAME: BOUND}}, "certificates", "0.00400 rad/s, expected were 0.00300 rad/s"),
    ({"evaluation": [row(NAME, 0.2), row("linear/mixed", 0.1)]}, "errors", "“linear, mixed H2-H∞” has smaller errors"),
    ({"evaluation": RIVAL, "observers": LOSSES}, "errors", "are lost it diverges (the deployed one: 38"),
    ({"evaluation": BETTER_IN_ONE}, "errors", "The correction does not improve current"),
    ({"observers": {"learned": {}}}, "certificates", "No robust observer"),
]
NOT_READY: list[tuple[dict[str, Any], str, str]] = [
    ({"evaluation": [row(OPEN_LOOP, 0.9)], "study": {"deployed": OPEN_LOOP}}, "errors", "no better than its model"),
    ({"evaluation": [row(NAME, None)]}, "models", "diverge"),
    ({"evaluation": [row(NAME, 0.9), row(OPEN_LOOP, 0.9)]}, "errors", "no better than its model"),
    ({"left_out": {"rows": [row(NAME, None)], "failed": {}}}, "left-out", "diverges on some"),
    ({"study": {"deployed": None}}, "run", "stopped before an observer was designed"),
]


@pytest.mark.parametrize(
    ("status", "parts", "section", "text"),
    [(Status.CHECK, *case) for case in CHECK] + [(Status.NOT_READY, *case) for case in NOT_READY],
)
def test_every_reason_sets_the_status_and_leads_to_its_section(
    status: Status, parts: dict[str, Any], section: str, text: str
) -> None:
    found = judge(Facts(metrics(**parts)))
    assert found.status is status
    assert [(r.status, r.section) for r in found.reasons if text in r.text] == [(status, section)]
    assert status is Status.CHECK or text in found.sentence
    assert "can be deployed" not in found.sentence


def test_a_unit_with_several_times_the_error_of_the_others_is_named_with_its_error_and_ratio() -> None:
    """Not named: a unit of twice their error, one that moved less and has the same error, one among few or set aside."""
    units = {"a": 0.2, "b": 0.22, "c": 0.18, "d": 0.44, "bad": 1.2}
    rows = [row(NAME, percent, unit) for unit, percent in units.items()] + [row("koopman/open_loop", 9.0)]
    text = "Units with several times the error of the others: bad has 1.20 % in velocity, 5.7 times their median."
    assert [r.text for r in judge(Facts(metrics(evaluation=rows))).reasons] == [text]
    nominal = [r | {"role": "nominal"} if r["unit"] == "bad" else r for r in rows]
    assert [r.text for r in judge(Facts(metrics(evaluation=nominal))).reasons] == [text]
    slow = [r | {"rms": 0.004} if r["unit"] == "bad" else r for r in rows]
    few = [r for r in rows if r["unit"] != "d"]
    aside = [r | {"role": "outlier"} if r["unit"] == "bad" else r for r in rows]
    for others in (slow, few, aside):
        assert judge(Facts(metrics(evaluation=others))).status is Status.READY


def test_a_rival_that_is_better_in_one_hidden_state_is_named_with_the_state() -> None:
    means = {NAME: (16.0, 8.0), "learned": (12.0, 10.6), "linear/mixed": (20.0, 7.0)}
    rows = [row(name, velocity) for name, (velocity, _) in means.items()] + [row("filtered_difference", 12.3)]
    rows += [row(name, force, channel="force") for name, (_, force) in means.items()]
    texts = [r.text for r in judge(Facts(metrics(evaluation=rows))).reasons if "smaller errors" in r.text]
    better = {"learned": "velocity", "linear, mixed H2-H∞": "force"}
    assert texts == [f"“{name}” has smaller errors of {state}." for name, state in better.items()]
    loaded = metrics(evaluation=[r | {"condition": "load"} for r in rows], study={"identify_on": "load"})
    assert any("smaller errors of force, loaded." in r.text for r in judge(Facts(loaded)).reasons)


def test_a_bound_that_a_unit_exceeds_says_so_where_it_stands() -> None:
    rows = [row(NAME, 0.1), row(NAME, 0.2, "c"), row(NAME, 0.3, "d"), row("koopman/open_loop", 9.0)]
    (text, _) = judge(Facts(metrics(observers={NAME: BOUND}, evaluation=rows))).certified
    assert "the RMS error is at most 0.00300 rad/s in velocity (exceeded by unit d, c); about one new unit" in text


def test_ready_means_that_it_can_be_deployed_and_voids_stand_beside() -> None:
    found = judge(Facts(metrics()))
    assert found.status is Status.READY
    assert not found.reasons
    assert "can be deployed" in found.sentence
    assert "velocity from angle" in found.sentence
    assert found.certified == ["At run time: the gain from the model's one-step residual to the error is at most 2.00."]
    assert "controller uses the estimate" in found.void[0]
    assert judge(Facts(metrics(observers={NAME: {}}))).void == []


def test_errors_against_the_true_signal_stand_beside_those_against_the_recording() -> None:
    known = {"true_error_percent": 0.31, "true_rms": 0.0062, "true_lag_s": 0.0011}
    facts = metrics(evaluation=[{**row(NAME, 0.024), **known}, row("koopman/open_loop", 0.9)])
    (number,) = judge(Facts(facts)).numbers
    assert number.value == "0.0240"
    assert number.notes[-1] == "against the true signal: 0.310 %, 1.1 ms late"
    observers = {NAME: {"left_out_to_training": {"velocity": 1.5}}}
    (beside,) = judge(Facts(metrics(observers=observers, evaluation=facts["evaluation"]))).numbers
    assert "in training 1.50 times as large on units left out" in beside.notes
    assert not any("left out" in note for note in number.notes)
    first = errors(Facts(facts)).tables[0]
    assert "velocity: against the true signal (%)" in first.labels
    assert "velocity: against the true signal (%)" not in errors(Facts(metrics())).tables[0].labels


def test_the_best_certified_observer_is_one_that_was_designed() -> None:
    entries = {f"l/{method}": {"worst_case_h2": 1.0} for method in ("open_loop", "mixed", "worst_case_h2")}
    rows = [row("l/open_loop", 0.1), row("l/mixed", 0.5), row("l/worst_case_h2", 0.4), row(NAME, 0.2)]
    first = errors(Facts(metrics(observers={**entries, NAME: {}}, evaluation=rows))).tables[0]
    notes = {cells[0].text: cells[0].note for cells in first.rows}
    assert notes["l, worst-case H2"].startswith("best with a certificate")
    signals = {**metrics()["observers"], NAME: {"set_certified": True}}
    first = errors(Facts(metrics(observers=signals, evaluation=rows))).tables[0]
    assert first.rows[first.chosen[0]][0].note.startswith("deployed and best with a certificate")


def test_a_run_ends_with_a_verdict_numbers_and_a_path(tmp_path: Path) -> None:
    verdict, point, error, flagged, path = lines_of(RunResult(tmp_path, metrics(outliers=[FLAGGED])))
    flag = "Flagged as not belonging to the batch: b. Inspect these units before they are shipped."
    assert point == f"point 1: {flag}"
    assert verdict.startswith("CHECK: “Koopman, estimator” estimates velocity from angle. Check 1 point")
    assert error == "error of velocity: 0.200 % of the largest value (worst unit b: 0.200 %)"
    assert flagged == "units flagged: 1 of 1 (b)"
    assert path == f"results: {tmp_path}"
    early, alert, _ = lines_of(RunResult(tmp_path, metrics(study={"deployed": None, "alerts": ["stuck"]})))
    assert early == "units: 3, no observer has been designed yet"
    assert alert == "check: stuck"


def test_the_head_names_every_hidden_state_and_its_worst_condition(tmp_path: Path) -> None:
    """Three states in two conditions: the largest error is that of the last state in the other condition."""
    means = {"velocity": (0.2, 0.1), "current": (6.2, 7.0), "force": (8.0, 45.0)}
    rows = [
        row(NAME, percent, channel=channel) | {"condition": condition}
        for channel, of in means.items()
        for condition, percent in zip(("default", "cold"), of, strict=True)
    ]
    rows += [row("koopman/open_loop", 90.0, channel=channel) for channel in means]
    conditions = {"study": {"conditions": ["default", "cold"]}}
    _, _, velocity, current, force, _ = lines_of(RunResult(tmp_path, metrics(evaluation=rows, **conditions)))
    assert "cold" not in velocity
    assert current.endswith("(worst unit b: 6.20 %; cold: 7.00 %)")
    assert force == "error of force: 8.00 % of the largest value (worst unit b: 8.00 %; cold: 45.0 %)"
    assert "force (45.0 %" in judge(Facts(metrics(evaluation=rows, **conditions))).reasons[-1].text
    rows.append(row(NAME, None, unit="c", channel="velocity") | {"condition": "cold"})
    diverged = metrics(evaluation=rows, **conditions)
    assert judge(Facts(diverged)).status is Status.NOT_READY
    assert any("cold: diverged" in line for line in lines_of(RunResult(tmp_path, diverged)))


def lines_of(result: RunResult) -> list[str]:
    """Return the lines of a summary, each with a colon in place of the space between name and text."""
    return [re.sub("  +", ": ", line) for line in result.summary().splitlines()[1:]]


def test_observers_are_ranked_by_their_errors() -> None:
    rows = [row("koopman/open_loop", 0.9), row(NAME, 0.2), row("l/h2", None), row("learned", 0.3)]
    lines = ranking(Facts(metrics(evaluation=rows)))
    assert [line.split()[0] for line in lines[2:]] == [NAME, "learned", "koopman/open_loop", "l/h2"]
    assert "<- deployed" in lines[2]
    assert lines[-1].split()[-1] == "diverged"


def test_the_bound_of_a_filter_bank_is_that_of_units_left_out() -> None:
    facts = Facts(metrics(observers={NAME: {**BOUND, "set_bound": {"velocity": 0.5}}}))
    expected = "Measured on units left out of its regression: the RMS error is at most 0.500 rad/s in velocity; about "
    assert judge(facts).certified[0] == f"{expected}one new unit in 4 exceeds it."


def test_a_large_error_is_a_reason_to_check() -> None:
    verdict = judge(Facts(metrics(evaluation=[row(NAME, 13.1), row("koopman/open_loop", 40.0)])))
    assert verdict.status is Status.CHECK
    assert [r.text for r in verdict.reasons] == ["The error is large: velocity (13.1 % of the largest value)."]


def test_errors_that_differ_between_runs_are_means_and_worst_units_of_every_run() -> None:
    better = metrics(evaluation=[row(NAME, 0.1), row(NAME, 0.3, "c"), row("koopman/b", None)])
    first, second = ({"identify": {"refine": refine}} for refine in (True, False))
    found = differences([compared(first, Facts(metrics())), compared(second, Facts(better))])
    assert found["settings"] == {"identify.refine": [True, False]}
    assert found["errors in percent"] == {
        f"{NAME}: velocity, default, worst unit": [0.2, 0.3],
        "koopman/open_loop: velocity, default": [0.9, None],
        "koopman/open_loop: velocity, default, worst unit": [0.9, None],
        "koopman/b: velocity, default": [None, "diverged"],
    }
