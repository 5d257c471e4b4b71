"""What `kros check` says of units whose hidden channels were not recorded, by the number of units behind the monitor's bound."""

from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from kros.core import DataError
from kros.data import Channel, Role, from_arrays
from kros.lifting import Lifting
from kros.observer import Observer, SampleStatus
from kros.observer.monitor import Monitor, octaves
from kros.report.unit_verdicts import html_text, junit_text, verdict_lines, with_verdict, worst
from kros.study.commands.check import check_recordings, errors_beside_bounds, monitored
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
    ((_, _, _, status, _),) = recordings(units, noise).estimates()
    assert bool((status & SampleStatus.UNCERTIFIED).any()) == (noise == 100.0)
    assert row["status"] == ("outlier" if outlier else "cannot tell")
    row = with_verdict(row)
    assert row["verdict"] == ("FAIL" if outlier else "UNDECIDED")
    assert "no score without velocity" in row["reason"]
    assert (f"from {units} units of which {FEWEST} are needed" in row["reason"]) == (units < FEWEST)


SCORED = {"unit": "a", "condition": "cold", "score": 1.0, "threshold": 2.0, "status": "ok"}
SCORED |= {"outlier": False, "units": 12, "left_out": []}


def test_a_unit_has_the_worst_verdict_of_its_conditions_and_hostile_names_stay_text() -> None:
    plain, hostile = SCORED | {"detectable": {"force": 5.0}, "fewest_units": 14}, '<b "\x00\u202e&'
    stated = [("a", "cold", "ok"), (hostile, "cold", "ok"), (hostile, "hot", "cannot tell")]
    stated += [("c", "cold", "outlier"), ("c", "hot", "cannot tell")]
    rows = [
        with_verdict(plain | {"unit": unit, "condition": condition, "status": status, "outlier": status == "outlier"})
        for unit, condition, status in stated
    ]
    verdicts = [line.split()[0] for line in verdict_lines(rows) if not line.startswith(" ")]
    assert verdicts == ["PASS", "UNDECIDED", "FAIL"]
    assert (worst(rows[:1]), worst(rows[:3]), worst(rows)) == ("PASS", "UNDECIDED", "FAIL")
    assert ">&lt;b &#34;" in html_text(rows)
    suite = ElementTree.fromstring(junit_text(rows))
    assert (suite.attrib["tests"], suite.attrib["failures"], suite.attrib["errors"]) == ("3", "1", "1")
    assert [[child.tag for child in case] for case in suite] == [[], ["error"], ["failure"]]
    assert suite[1].attrib["name"] == '<b "__&'


def test_recordings_of_new_units_are_looked_at_as_those_of_a_study_are(caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(0)
    first, other = (np.cumsum(rng.normal(size=(200, 2)), axis=0) for _ in range(2))
    check_recordings(from_arrays({"a": [first, other]}, CHANNELS, 0.01))
    assert not caplog.records
    with pytest.raises(DataError, match="is a copy of episode 0 of unit a"):
        check_recordings(from_arrays({"a": [first, first.copy()]}, CHANNELS, 0.01))
    other[100, 0] += 1e3
    check_recordings(from_arrays({"a": [first * (1, 0) + (0, 2), other * (1, 0) + (0, 2)]}, CHANNELS, 0.01))
    assert "input 'force' stays where it is in each of 2 episodes, in the first at 2" in caplog.text
    assert "Episode 1 of unit a (default): position jumps by" in caplog.text


@pytest.mark.parametrize(
    ("verdict", "gains", "ratio", "units", "text"),
    [
        ("PASS", {"speed": 3.0, "force": 40.0}, 0.9, 12, "a change of the gain of force above 40 % would be detected"),
        ("UNDECIDED", {"speed": 3.0, "force": 116.0}, 0.9, 12, "only a change of the gain of force above 116 %"),
        ("UNDECIDED", {"force": 40.0}, 1.5, 12, "error of force 3.00 N, at most 2.00 N expected"),
        ("FAIL", {"force": 40.0}, 2.1, 12, "error of force 4.20 N, at most 2.00 N expected"),
        ("FAIL", {"force": 40.0}, None, 12, "error of force – N, at most 2.00 N expected"),
        ("UNDECIDED", {"force": 40.0}, 2.1, FEWEST - 1, "error of force 4.20 N"),
    ],
)
def test_a_pass_excludes_a_change_of_every_hidden_state_and_an_error_beyond_the_bound(
    verdict: str, gains: dict[str, float], ratio: float | None, units: int, text: str
) -> None:
    error = {"state": "force", "rms": ratio and 2.0 * ratio, "bound": 2.0, "ratio": ratio, "unit": "N"}
    row = with_verdict(SCORED | {"detectable": gains, "error": error, "units": units})
    assert row["verdict"] == verdict
    assert text in row["reason"]


def test_errors_stand_beside_bounds_with_the_change_of_gain_that_they_exclude() -> None:
    """A mass whose recorded velocity has 0.4 of its size: the error is 0.6 of it, and the change that shows is known."""
    one = recordings(FEWEST, 0.0)
    values = one.population.read(one.population.episodes[0])
    A, B = one.observer.A, one.observer.B
    x = np.zeros((len(values), 2))
    for k in range(len(values) - 1):
        x[k + 1] = A @ x[k] + B[:, 0] * values[k, 1]
    whole = np.column_stack([x, values[:, 1]])
    channels = (CHANNELS[0], Channel("velocity", Role.STATE, "m/s", False), CHANNELS[1])
    population = from_arrays({"good": [whole], "bad": [whole * (1.0, 0.4, 1.0)]}, channels, 0.01)
    bound = 0.5 * float(x[:, 1].std())
    record = {"facts": {one.observer.name: {"set_bound": {"velocity": bound, "position": 1.0}}}}
    facts, config = SimpleNamespace(identify_on="default"), SimpleNamespace(sensor={})
    context = SimpleNamespace(facts=facts, deployed=one.observer, observers_record=record, config=config)
    found = errors_beside_bounds(context, population, {"good": {}, "bad": {}})
    ((good,), (bad,)) = found["good", "default"], found["bad", "default"]
    assert (good["state"], good["unit"], good["bound"]) == ("velocity", "m/s", bound)
    assert good["ratio"] < 1e-9
    assert bad["rms"] == pytest.approx(0.6 * float(np.sqrt((x[:, 1] ** 2).mean())))
    assert good["gain_percent"] == pytest.approx(50.0)

    def row_of(gain: float) -> dict[str, float]:
        unit = from_arrays({"u": [whole * (1.0, gain, 1.0)]}, channels, 0.01)
        return errors_beside_bounds(context, unit, {"u": {}})["u", "default"][0]

    change = 1.01 * row_of(1.2)["gain_percent"] / 100  # the error is a part of the state
    assert row_of(1.2)["ratio"] < 1
    assert all(row_of(1.2 * (1 + sign * change))["ratio"] > 1 for sign in (-1, 1))
    context.observers_record = {"facts": {}}
    assert errors_beside_bounds(context, population, {}) == {}
