"""Curves, doubling severities and intervals in the report."""

import numpy as np
import pytest

from kros.core.errors import DimensionError
from kros.evaluate import unit_interval
from kros.evaluate.disturb import Kind, severity_of_growth
from kros.evaluate.intervals import interval_rows
from kros.report.disturbances import curves
from kros.report.error_tables import error_tables


def test_noise_doubles_an_error_where_its_own_share_is_root_three():
    """``e^2 = e_0^2 + (g s)^2``: doubled at ``s = sqrt(3) e_0 / g``, wherever it was sampled."""
    e_0, g = 0.2, 30.0
    for severities in ([0, 1e-3, 1e-2, 1e-1], [0, 1.0]):
        s = np.array(severities)
        assert severity_of_growth(s, np.sqrt(e_0**2 + (g * s) ** 2)) == pytest.approx(np.sqrt(3) * e_0 / g)


def test_growth_beyond_what_was_tried_and_divergence():
    assert severity_of_growth([0, 1, 2], [1.0, 1.5, 1.9]) == np.inf
    assert (
        severity_of_growth([0, 1, 2], [1.0, 1.5, np.nan]) == 2
    )  # lost somewhere between: not before the last one that is known
    assert severity_of_growth([0, 1, 2], [np.inf, np.inf, np.inf]) == 0
    with pytest.raises(DimensionError, match="zero"):
        severity_of_growth([1, 2], [1.0, 2.0])


def row(observer, kind, severity, mean, condition="noload"):
    error = {"mean": mean, "worst": None if mean is None else 2 * mean}
    return {
        "observer": observer,
        "disturbance": kind,
        "severity": severity,
        "condition": condition,
        "channel": "v",
        "error_percent": error,
    }


def test_curves_begin_without_disturbance_and_take_one_condition():
    rows = [
        row("a", "none", 0.0, 1.0),
        row("a", "bias", 0.1, 2.0),
        row("a", "bias", 0.2, None),
        row("a", "none", 0.0, 9.0, "load"),
    ]
    curve = curves(rows, "noload")["a"][Kind.BIAS]["v"]
    np.testing.assert_array_equal(curve.severities, [0, 0.1, 0.2])
    np.testing.assert_array_equal(curve.errors, [1, 2, np.inf])


def evaluation(units=8, seed=0):
    rng = np.random.default_rng(seed)
    return [
        {
            "observer": o,
            "unit": f"u{i}",
            "role": "nominal" if i == 0 else "off_nominal",
            "condition": "noload",
            "channel": c,
            "error_percent": e,
        }
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
    cell = error_tables(metrics)[0].cells["b"]["v"]
    assert cell.interval == found["b", "noload", "v"]
    assert cell.interval[0] < cell.mean < cell.interval[1]
    assert len(found) == 4


def test_no_interval_where_an_estimate_diverged_or_units_are_few():
    rows = evaluation()
    rows[1]["error_percent"] = None
    assert ("a", "noload", "v") not in intervals(rows)
    assert interval_rows(evaluation(units=3)) == []
