"""In what runs differ, from settings and metrics made by hand."""

from __future__ import annotations

from tests.unit.test_report_head import NAME, metrics, row

from kros.report.compare import compared, differences, lines
from kros.report.facts import Facts


def differing():
    first = {"name": "a", "identify": {"refine": True}, "split": {"test": None}}
    second = {"name": "a", "identify": {"refine": False}, "estimator": {"lags": [1, 2]}}
    better = metrics(evaluation=[row(NAME, 0.1), row(NAME, 0.3, "c"), row("koopman/b", None)])
    return differences([compared(first, Facts(metrics())), compared(second, Facts(better))])


def test_only_settings_that_differ_are_compared():
    assert differing()["settings"] == {"identify.refine": [True, False], "estimator.lags": [None, "1, 2"]}


def test_errors_that_differ_are_means_and_worst_units_of_every_run():
    assert differing()["errors in percent"] == {
        f"{NAME}: velocity, default, worst unit": [0.2, 0.3],
        "koopman/open_loop: velocity, default": [0.9, None],
        "koopman/open_loop: velocity, default, worst unit": [0.9, None],
        "koopman/b: velocity, default": [None, "diverged"],
    }


def test_lines_have_a_column_for_every_run():
    shown = lines(["one", "two"], differing())
    assert ["identify.refine", "True", "False"] in [line.split() for line in shown]
    assert "recordings: nothing differs" in shown
