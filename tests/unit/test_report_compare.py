"""Runs beside each other, from settings and metrics made by hand, and the command on the small demo."""

from __future__ import annotations

from tests.unit.test_report_head import NAME, metrics, row

from kros.report.compare import change, comparison, lines, sections
from kros.report.facts import Facts
from kros.report.html import filled


def compared():
    first = {"name": "a", "identify": {"refine": True}, "split": {"test": None}}
    second = {"name": "a", "identify": {"refine": False}, "estimator": {"lags": [1, 2]}}
    better = metrics(evaluation=[row(NAME, 0.1), row(NAME, 0.3, "c"), row("koopman/<b>", None)])
    runs = {"one": (first, Facts(metrics())), "two": (second, Facts(better))}
    return comparison(runs)


def test_only_settings_that_differ_are_compared():
    assert compared()["settings"] == {"identify.refine": ["True", "False"], "estimator.lags": [None, "1, 2"]}


def test_errors_are_means_and_worst_units_of_every_run():
    errors = compared()["errors"]
    assert errors[f"{NAME}: velocity"] == [0.2, 0.2]
    assert errors[f"{NAME}: velocity, worst unit"] == [0.2, 0.3]
    assert errors["koopman/open_loop: velocity"] == [0.9, None]
    assert errors["koopman/<b>: velocity"] == [None, "diverged"]


def test_a_change_is_of_numbers_that_both_runs_have():
    assert (change(0.2, 0.3), change(0.2, 0.1), change(None, 1.0), change("a", "b")) == (
        "+50.0 %",
        "−50.0 %",
        None,
        None,
    )


def test_lines_and_page_have_a_column_for_every_run_and_escape_texts():
    shown = sections(["one", "two"], compared())
    text = "\n".join(line for section in shown for line in lines(section))
    assert "identify.refine  True  False" in text
    page = filled("one and two", "runs beside each other", shown)
    assert "koopman/&lt;b&gt;: velocity" in page
    assert "Summary</a>" not in page
    same = sections(["one", "two"], {"settings": {}})
    assert lines(same[0])[1:] == ["Settings that differ", "Nothing differs."]
