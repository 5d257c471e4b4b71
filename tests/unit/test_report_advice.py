"""What the report tells to do next, for metrics made by hand."""

from __future__ import annotations

from typing import Any

import pytest

from kros.report.advice import advice
from kros.report.sections.outliers import score_text
from kros.report.sections.uncertainty import noise_text

NAME = "koopman/worst_case_h2"


def errors(**percent: float | None) -> list[dict[str, Any]]:
    """Evaluation rows of one off-nominal unit, by observer with dots for slashes."""
    row = {"unit": "b", "role": "off_nominal", "condition": "noload", "channel": "velocity", "rms": None}
    return [{**row, "observer": name.replace("__", "/"), "error_percent": value} for name, value in percent.items()]


def metrics(**parts: Any) -> dict[str, Any]:
    study = {"units": 3, "conditions": ["noload"], "identify_on": "noload", "sample_period_s": 0.001, "deployed": NAME}
    return {"study": study, "evaluation": errors(koopman__worst_case_h2=0.2, koopman__open_loop=0.9), **parts}


def share(at_peak: float) -> dict[str, Any]:
    return {"koopman": {"noise_share": {"median": 0.1, "at_peak": at_peak, "peak_hz": 50.0}}}


def test_a_run_that_stopped_early_asks_for_nothing() -> None:
    found = metrics()
    assert advice({**found, "study": {k: v for k, v in found["study"].items() if k != "deployed"}}) == []


def test_a_good_observer_is_deployed() -> None:
    assert "deployed.json" in " ".join(advice(metrics(), ("position",)))
    without = metrics(observers={NAME: {"relift_certified": False}})
    assert "No certificate covers it as it runs" in " ".join(advice(without))


@pytest.mark.parametrize(
    ("percent", "text"),
    [
        ({"koopman__worst_case_h2": None, "koopman__open_loop": 0.9}, "its estimates diverge"),
        ({"koopman__worst_case_h2": 0.899, "koopman__open_loop": 0.9}, "no better than its model alone"),
        (
            {"koopman__worst_case_h2": 0.2, "koopman__open_loop": 0.9, "linear__residual_h2": 0.1},
            "Look at “linear, residual-shaped H2” before",
        ),
    ],
)
def test_other_observers_are_not(percent: dict[str, float | None], text: str) -> None:
    found = " ".join(advice(metrics(evaluation=errors(**percent))))
    assert text in found
    assert "export" not in found


def test_noise_decides_whether_longer_recordings_help() -> None:
    assert (
        "80 % of how much Koopman models differ, where they do most (50.0 Hz), comes from the recordings' length"
        in advice(metrics(uncertainty=share(0.8)))[-1]
    )
    assert "would change little: 97 %" in advice(metrics(uncertainty=share(0.03)))[-1]
    assert noise_text({"koopman": {}}) == []
    assert "more recordings of the same units would not shrink" in noise_text(share(0.03))[0]
    assert "record longer" in noise_text(share(0.8))[0]


def test_flagged_units_come_first_and_count_until_they_are_dropped() -> None:
    rows = [
        {"unit": u, "condition": "load", "score": s, "outlier": s > 5, "freq_hz": 17.4} for u, s in (("a", 6.0), ("z", 9.0), ("b", 1.0))
    ]
    (first, *_) = advice(metrics(outliers=rows, units=[{"unit": u, "group": ""} for u in "abz"]))
    assert first.startswith("Inspect z (loaded, differs most at 17.4 Hz), a (loaded, differs most at 17.4 Hz) before shipping.")
    assert "drop_outliers" in first
    filed = metrics(outliers=rows[1:], units=[{"unit": "z", "group": "outliers"}])
    assert "drop_outliers" not in advice(filed)[0]


def test_a_flagged_unit_is_described_with_its_range() -> None:
    row = {"unit": "z", "condition": "load", "score": 16.2, "freq_hz": 17.36, "entry": (2, 1)}
    row |= {"excess_db": 16.0, "lowest_db": 10.9, "highest_db": 17.0, "agreement": 0.25}
    text = score_text(row, (("position", "velocity", "current"), ("target_position", "target_velocity")))
    assert text.startswith("Unit z (loaded) scores 16.2 dB, most at 17.4 Hz in the response of current to target velocity.")
    assert "under every choice of the nominal, by 10.9 to 17.0 dB" in text
    assert "25 %" in text
    assert score_text({"unit": "z", "condition": "load", "score": 16.2}, None) == "Unit z (loaded) scores 16.2 dB."
