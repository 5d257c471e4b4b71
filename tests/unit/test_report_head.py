"""The head of the report, what stands behind observers, and the deployment card, for metrics made by hand."""

from __future__ import annotations

from typing import Any

import pytest

from kros.report.content import Level
from kros.report.error_tables import error_table
from kros.report.summary import summary
from kros.report.trust import best_certified, dropout_text, sensor_text, trust_of, trusts

NAME = "koopman/memory"


def row(observer: str, percent: float | None, unit: str = "b", channel: str = "velocity") -> dict[str, Any]:
    found = {"observer": observer, "unit": unit, "role": "off_nominal", "condition": "default", "channel": channel}
    return {**found, "error_percent": percent, "rms": percent and percent / 50}


def metrics(**parts: Any) -> dict[str, Any]:
    study = {
        "units": 3,
        "conditions": ["default"],
        "identify_on": "default",
        "sample_period_s": 0.002,
        "deployed": NAME,
    }
    study |= {"channels": {"velocity": "rad/s"}} | parts.pop("study", {})
    observers = {
        NAME: {"status": "trained", "relift_certified": True, "relift_gain": 2.0},
        "linear/worst_case_h2": {"status": "certified"},
    }
    return {
        "study": study,
        "observers": observers,
        "evaluation": [row(NAME, 0.2), row("koopman/open_loop", 0.9)],
        **parts,
    }


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
        (
            {"observers": {NAME: {"relift_certified": False}, "linear/mixed": {}}},
            Level.LOOK,
            "trust",
            "No certificate covers",
        ),
        (
            {"evaluation": [row(NAME, 0.2), row("linear/mixed", 0.1)]},
            Level.LOOK,
            "observers",
            "“linear, mixed H2-H∞” is more accurate",
        ),
        ({"evaluation": [row(NAME, None)]}, Level.STOP, "models", "diverge"),
        (
            {"evaluation": [row(NAME, 0.9), row("koopman/open_loop", 0.9)]},
            Level.STOP,
            "observers",
            "no better than its model alone",
        ),
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
def test_every_alert_sets_the_light_and_leads_to_its_section(
    parts: dict[str, Any], light: Level, section: str, text: str
) -> None:
    found = summary(metrics(**parts), ("angle",))
    assert found.light is light
    assert [(a.level, a.section) for a in found.alerts if text in a.text] == [(light, section)]
    assert light is Level.LOOK or text in found.sentence


def test_the_best_certified_observer_is_one_that_was_designed() -> None:
    entries = {
        "l/open_loop": {"worst_case_h2": 1.0},
        "l/mixed": {"worst_case_h2": 1.0},
        "l/h2": {"worst_case_h2": 1.0},
        NAME: {},
    }
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
        {
            "observer": NAME,
            "disturbance": kind,
            "severity": s,
            "condition": "default",
            "channel": "velocity",
            "error_percent": {"mean": e},
        }
        for kind, s, e in tried
    ]
    found = metrics(robustness=rows)
    assert sensor_text(found, NAME, ()) == "noise 0.10 %; delay less than 1"
    assert sensor_text(found, "learned", ()) == dropout_text(found, "learned", trust_of({}), ()) == "not tried"
    lossy = trust_of({"dropout_rate": 0.05, "dropout_certified": True})
    assert dropout_text(found, NAME, lossy, ()) == "certified at 5 %; none that was tried doubles the error"
    assert set(trusts(found)) == {NAME, "linear/worst_case_h2", "koopman/open_loop"}
