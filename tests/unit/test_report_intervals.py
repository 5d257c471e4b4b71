"""Intervals in the report."""

import numpy as np

from kros.evaluate import unit_interval
from kros.evaluate.over_units import interval_rows
from kros.report.facts import Facts


def evaluation(units=8, seed=0):
    rng = np.random.default_rng(seed)
    return [
        {"observer": o, "unit": f"u{i}", "role": "off_nominal" if i else "nominal", "condition": "noload"}
        | {"channel": c, "error_percent": e}
        for o in ("a", "b")
        for c in ("v", "i")
        for i, e in enumerate(rng.uniform(1, 2, units))
    ]


def intervals(rows):
    """Intervals by observer, condition and channel."""
    return {(r["observer"], r["condition"], r["channel"]): tuple(r["interval"]) for r in interval_rows(rows)}


def test_intervals_of_all_observers_are_those_of_each():
    rows = evaluation()
    found = intervals(rows)
    values = [r["error_percent"] for r in rows if (r["observer"], r["channel"], r["role"]) == ("b", "v", "off_nominal")]
    np.testing.assert_allclose(found["b", "noload", "v"], unit_interval(values))
    metrics = {"study": {"identify_on": "noload"}, "evaluation": rows, "intervals": interval_rows(rows)}
    cell = Facts(metrics).tables[0].cells["b"]["v"]
    assert tuple(cell.interval) == found["b", "noload", "v"]
    assert cell.interval[0] < cell.mean < cell.interval[1]
    assert len(found) == 4


def test_no_interval_where_an_estimate_diverged_or_units_are_few():
    rows = evaluation()
    rows[1]["error_percent"] = None
    assert ("a", "noload", "v") not in intervals(rows)
    assert interval_rows(evaluation(units=3)) == []
