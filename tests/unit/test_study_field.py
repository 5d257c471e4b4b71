"""What `kros check` says of units whose hidden channels were not recorded, by the number of units behind the monitor's bound."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from kros.data import Channel, Role, from_arrays
from kros.lifting import Lifting
from kros.observer import Observer
from kros.observer.monitor import Monitor, octaves
from kros.report.unit_verdicts import html_text, junit_text, verdict_lines, with_verdict, worst
from kros.study.commands.check import monitored
from kros.study.commands.field import FieldRecordings
from kros.uncertainty.outliers.score import FEWEST_UNITS as FEWEST

CHANNELS = (Channel("position", Role.STATE, "rad", True), Channel("force", Role.INPUT, "N"))


def recordings(units: int, noise: float) -> FieldRecordings:
    """A mass of which the position alone was recorded, with noise; the bound is one."""
    A, B = np.array([[1.0, 0.01], [0.0, 0.99]]), np.array([[0.0], [0.01]])
    plain = Observer.open_loop("model", Lifting(("position", "velocity")), A, B, (0,), ("force",), 0.01)
    weights = np.array([[3, 3, 3, 3, 2, 2]])
    watch = Monitor(octaves(), 1e-2, 10, np.ones(1), np.ones((1, 6)), weights, 0.02, units=units)
    rng = np.random.default_rng(1)
    u = rng.normal(size=500)
    x = np.zeros((500, 2))
    for k in range(499):
        x[k + 1] = A @ x[k] + B[:, 0] * u[k]
    y = x[:, 0] + noise * rng.normal(size=500)
    y[0] = 0.0
    population = from_arrays({"a": [np.column_stack([y, u])]}, CHANNELS, 0.01)
    return FieldRecordings(replace(plain, monitor=watch), population, {"a": {}})


@pytest.mark.parametrize(
    ("units", "noise", "outlier"), [(FEWEST, 100.0, True), (FEWEST, 1e-3, False), (FEWEST - 1, 100.0, False)]
)
def test_a_unit_beyond_the_bound_is_an_outlier_where_enough_units_made_it(
    units: int, noise: float, outlier: bool
) -> None:
    (row,) = monitored(recordings(units, noise))
    assert (row["outlier"], row["score"], row["missing"]) == (outlier, None, ["velocity"])
    assert (row["level_db"] > 0) == (noise == 100.0)
    assert row["status"] == ("outlier" if outlier else "cannot tell")
    row = with_verdict(row)
    assert row["verdict"] == ("FAIL" if outlier else "UNDECIDED")
    assert "no score without velocity" in row["reason"]
    assert (f"from {units} units of which {FEWEST} are needed" in row["reason"]) == (units < FEWEST)


def test_a_unit_has_the_worst_verdict_of_its_conditions_and_hostile_names_stay_text() -> None:
    plain = {
        "score": 1.0,
        "threshold": 2.0,
        "detectable": 5.0,
        "detectable_hz": 3.0,
        "units": 12,
        "fewest_units": 14,
        "left_out": [],
        "outlier": False,
    }
    rows = [
        with_verdict(plain | {"unit": unit, "condition": condition, "status": status, "outlier": status == "outlier"})
        for unit, condition, status in (
            ("a", "cold", "ok"),
            ('<b "\x00\u202e&', "cold", "ok"),
            ('<b "\x00\u202e&', "hot", "cannot tell"),
            ("c", "cold", "outlier"),
            ("c", "hot", "cannot tell"),
        )
    ]
    assert [line.split()[0] for line in verdict_lines(rows) if not line.startswith(" ")] == [
        "PASS",
        "UNDECIDED",
        "FAIL",
    ]
    assert (worst(rows[:1]), worst(rows[:3]), worst(rows)) == ("PASS", "UNDECIDED", "FAIL")
    assert ">&lt;b &#34;" in html_text(rows)
    suite = ElementTree.fromstring(junit_text(rows))
    assert (suite.attrib["tests"], suite.attrib["failures"], suite.attrib["errors"]) == ("3", "1", "1")
    assert [[child.tag for child in case] for case in suite] == [[], ["error"], ["failure"]]
    assert suite[1].attrib["name"] == '<b "__&'
