"""The head of the report, what stands behind observers, and the deployment card, for metrics made by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.artifacts import save_artifact, write_json
from kros.core.lti import gain
from kros.lifting import Lifting
from kros.observer import Observer
from kros.observer.runtime import Seen
from kros.report.content import Level
from kros.report.error_tables import error_table
from kros.report.run_folder import RunFolder
from kros.report.sections import deployment
from kros.report.summary import summary
from kros.report.trust import best_certified, dropout_text, sensor_text, trust_of, trusts
from kros.synthesis.result import Injection

NAME = "koopman/memory"


def row(observer: str, percent: float | None, unit: str = "b", channel: str = "velocity") -> dict[str, Any]:
    found = {"observer": observer, "unit": unit, "role": "off_nominal", "condition": "default", "channel": channel}
    return {**found, "error_percent": percent, "rms": percent and percent / 50}


def metrics(**parts: Any) -> dict[str, Any]:
    study = {"units": 3, "conditions": ["default"], "identify_on": "default", "sample_period_s": 0.002, "deployed": NAME}
    study |= {"channels": {"velocity": "rad/s"}} | parts.pop("study", {})
    observers = {NAME: {"status": "trained", "relift_certified": True, "relift_gain": 2.0}, "linear/worst_case_h2": {"status": "certified"}}
    return {"study": study, "observers": observers, "evaluation": [row(NAME, 0.2), row("koopman/open_loop", 0.9)], **parts}


def test_a_manager_reads_light_sentence_and_numbers_with_units() -> None:
    found = summary(metrics(), ("angle",))
    assert (found.light, found.alerts) == (Level.GO, [])
    assert found.sentence.endswith("From angle alone it estimates velocity on machines like the 3 recorded ones.")
    assert (found.figures[0].value, found.figures[0].unit, found.figures[0].note.partition(";")[0]) == (
        "0.00400",
        "rad/s",
        "0.200 % of the largest value",
    )


BETTER_IN_ONE = [
    (NAME, 0.2, "velocity"),
    (NAME, 6.2, "current"),
    ("koopman/open_loop", 0.9, "velocity"),
    ("koopman/open_loop", 6.1, "current"),
]
FLAGGED = {"unit": "b", "condition": "default", "score": 9.0, "outlier": True}


@pytest.mark.parametrize(
    ("parts", "light", "section", "text"),
    [
        ({"outliers": [FLAGGED]}, Level.LOOK, "units", "Flagged as not belonging to the batch: b"),
        ({"study": {"alerts": ["a stuck sensor"]}}, Level.LOOK, "recordings", "a stuck sensor"),
        ({"observers": {NAME: {"relift_certified": False}, "linear/mixed": {}}}, Level.LOOK, "trust", "No certificate covers"),
        ({"evaluation": [row(NAME, 0.2), row("linear/mixed", 0.1)]}, Level.LOOK, "observers", "“linear, mixed H2-H∞” is more accurate"),
        ({"evaluation": [row(NAME, None)]}, Level.STOP, "models", "diverge"),
        ({"evaluation": [row(NAME, 0.9), row("koopman/open_loop", 0.9)]}, Level.STOP, "observers", "no better than its model alone"),
        (
            {"evaluation": [row(o, e, channel=c) for o, e, c in BETTER_IN_ONE]},
            Level.LOOK,
            "observers",
            "Correction brings nothing for current",
        ),
        ({"observers": {"learned": {}}}, Level.LOOK, "synthesis", "No robust observer"),
        ({"left_out": {"rows": [row(NAME, None)], "failed": {}}}, Level.STOP, "left-out", "diverges on some units"),
        ({"study": {"deployed": None}}, Level.STOP, "making", "stopped before an observer was made"),
    ],
)
def test_every_alert_sets_the_light_and_leads_to_its_section(parts: dict[str, Any], light: Level, section: str, text: str) -> None:
    found = summary(metrics(**parts), ("angle",))
    assert found.light is light
    assert [(a.level, a.section) for a in found.alerts if text in a.text] == [(light, section)]
    assert light is Level.LOOK or text in found.sentence


def test_the_two_sets_are_told_apart() -> None:
    assert trust_of({}).by_set == "no"
    assert trust_of({"worst_case_h2": 0.1}).by_set == "plants"
    assert trust_of({"set_bound_percent": {"velocity": 1.0}, "set_certified": False}).by_set == "no"
    both = trust_of({"worst_case_h2": 0.1, "set_bound_percent": {"velocity": 1.0}, "set_certified": True, "relift_certified": True})
    assert (both.by_set, both.as_it_runs.partition(",")[0]) == ("plants and signals", "yes")
    assert (trust_of({"relift_certified": False}).as_it_runs, trust_of({}).as_it_runs) == ("no", "no model")


def test_the_best_certified_observer_is_one_that_was_designed() -> None:
    entries = {"l/open_loop": {"worst_case_h2": 1.0}, "l/mixed": {"worst_case_h2": 1.0}, "l/h2": {"worst_case_h2": 1.0}, NAME: {}}
    rows = [row("l/open_loop", 0.1), row("l/mixed", 0.5), row("l/h2", 0.4), row(NAME, 0.2)]
    found = metrics(observers=entries, evaluation=rows)
    (table,) = error_table(rows, "default")
    assert best_certified(found, table, ["velocity"]) == "l/h2"
    signals = {**metrics()["observers"], NAME: {"set_certified": True, "set_bound_percent": {"velocity": 1.0}}}
    assert best_certified({**found, "observers": signals}, table, ["velocity"]) == NAME
    assert best_certified(metrics(), table, ["velocity"]) is None


def test_sensor_and_dropouts_are_those_that_double_the_error() -> None:
    tried = [("none", 0.0, 1.0), ("noise", 1e-3, 2.0), ("dropped", 0.1, 1.5), ("delay", 1, 9.0)]
    rows = [
        {"observer": NAME, "disturbance": kind, "severity": s, "condition": "default", "channel": "velocity", "error_percent": {"mean": e}}
        for kind, s, e in tried
    ]
    found = metrics(robustness=rows)
    assert sensor_text(found, NAME, ()) == "noise 0.10 %; delay less than 1"
    assert sensor_text(found, "learned", ()) == dropout_text(found, "learned", trust_of({}), ()) == "not tried"
    lossy = trust_of({"dropout_rate": 0.05, "dropout_certified": True})
    assert dropout_text(found, NAME, lossy, ()) == "certified at 5 %; none that was tried doubles the error"
    assert set(trusts(found)) == {NAME, "linear/worst_case_h2", "koopman/open_loop"}


def test_the_card_says_what_an_engineer_needs_and_what_voids_the_certificate(tmp_path: Path) -> None:
    lifting = Lifting(("angle", "velocity"), ("sin(3*angle + phase)",), ("phase",))
    A = np.array([[1.0, 0.002, 0.0], [0.0, 0.5, 0.25], [0.0, 0.0, 0.0]])
    observer = Observer(
        NAME, lifting, A, np.array([[0.0], [0.5], [0.0]]), (0,), ("torque",), gain(np.array([[0.5], [2.0], [0.0]]), 0.002), Injection.STATE, 0.002,
        {"phase": 0.3}, seen=Seen(np.array([6.0]), np.array([2.0])),
    )  # fmt: skip
    observer.save(tmp_path / "observers" / "deployed.json")
    save_artifact(tmp_path / "observers", "relift", {"certificates": {NAME: {"assumptions": ["any value of phase"]}}})
    write_json(tmp_path / "study.json", {})
    entry = {
        "set_certified": True,
        "set_bound_percent": {"velocity": 1.5},
        "set_outside": ["c"],
        "relift_certified": True,
        "relift_gain": 2.0,
    }
    entry["monitor"] = {"false_alarm_rate": 0.02, "units": 38, "hours": 0.5, "alarms": 1, "alarms_per_hour": [0.05, 11.0]}
    found = metrics(observers={NAME: entry}, study={"channels": {"angle": "rad", "torque": "Nm", "velocity": "rad/s"}})
    section = deployment.section(RunFolder(tmp_path), found)
    assert section is not None
    card = {term: " ".join(told) for term, told in section.card}
    assert card["Reads"].startswith("Measured: angle (rad) up to 6.00. Inputs: torque (Nm) up to 2.00.")
    assert "not measured: velocity" in card["Gives"]
    assert card["Rate"].startswith("One step every 2 ms (500 Hz)")
    assert "phase (0.300 on the nominal unit)" in card["Parameters"]
    # of the one-step map: 0.5 (angle - C angle), 0.002 and 0.5 from angle's row; -2, 0.5, 0.25, 0.5 and 2 from velocity's
    assert card["Cost of a step"].startswith("2 states, 8 multiply-adds and 1 lifted function;")
    assert "1.50 % in velocity (of the largest value)" in card["Certificate"]
    assert card["It assumes"] == "any value of phase."
    assert card["It is void"].startswith("When a loop is closed on the estimate")
    assert "of 38 units. One more good unit leaves it with a probability of 2 %, and 2.00 times an hour of motion" in card["Monitor"]
    assert "On c, whose recorded signals are outside" in card["It is void"]
    assert deployment.section(RunFolder(tmp_path), metrics(study={"deployed": None})) is None
