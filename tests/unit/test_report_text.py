"""Numbers and sentences of the report, against values counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from kros.report.canvas import decibel, log_ticks, power_of_ten, spread, thin, thin_log
from kros.report.error_tables import error_table
from kros.report.names import best_models, deployed_pair, model_label, number, observer_label, observer_look, paper_pair
from kros.report.sections.observers import baseline_notes
from kros.report.theme import Tone
from kros.report.verdict import verdict


def row(
    observer: str, unit: str, channel: str, percent: float | None, condition: str = "noload", role: str = "off_nominal"
) -> dict[str, object]:
    return {
        "observer": observer,
        "unit": unit,
        "role": role,
        "condition": condition,
        "channel": channel,
        "rms": None,
        "error_percent": percent,
    }


ROWS = [
    row("koopman/worst_case_h2", "a", "velocity", 0.1, role="nominal"),
    row("koopman/worst_case_h2", "b", "velocity", 0.2),
    row("koopman/worst_case_h2", "c", "velocity", 0.4),
    row("koopman/worst_case_h2", "z", "velocity", 50.0, role="outlier"),
    row("koopman/open_loop", "a", "velocity", 0.05, role="nominal"),
    row("koopman/open_loop", "b", "velocity", 0.9),
    row("koopman/open_loop", "c", "velocity", 0.3),
    row("koopman/kalman_tuned", "a", "velocity", 1.0, role="nominal"),
    row("koopman/kalman_tuned", "b", "velocity", None),
    row("koopman/kalman_tuned", "c", "velocity", 1.0),
]
METRICS = {
    "schema": 1,
    "study": {
        "units": 3,
        "conditions": ["load", "noload"],
        "identify_on": "noload",
        "sample_period_s": 0.001,
        "deployed": "koopman/worst_case_h2",
    },
    "evaluation": ROWS,
    "observers": {"koopman/worst_case_h2": {"worst_case_h2": 1.5, "gap_percent": 12.0, "relift_certified": False}},
    "outliers": [
        {"unit": "z", "condition": "load", "score": 9.0, "outlier": True},
        {"unit": "b", "condition": "load", "score": -1.0, "outlier": False},
    ],
}


def test_error_table_takes_off_nominal_units_alone() -> None:
    (table,) = error_table(ROWS, "noload")
    cell = table.cells["koopman/worst_case_h2"]["velocity"]
    assert (cell.nominal, cell.worst, cell.worst_unit, cell.diverged) == (0.1, 0.4, "c", 0)
    assert cell.mean == pytest.approx((0.2 + 0.4) / 2)
    assert table.best("velocity", "mean") == pytest.approx(0.3)
    assert table.best("velocity", "nominal") == 0.05
    assert table.best("velocity", "worst") == 0.4


def test_diverged_estimates_have_no_mean() -> None:
    (table,) = error_table(ROWS, "noload")
    cell = table.cells["koopman/kalman_tuned"]["velocity"]
    assert (cell.mean, cell.worst, cell.diverged) == (None, None, 1)


def test_nominal_alone_stands_for_the_mean() -> None:
    (table,) = error_table([row("linear/h2", "a", "velocity", 0.7, role="nominal")], "noload")
    assert table.cells["linear/h2"]["velocity"].mean == 0.7


def test_current_under_load_is_not_ranked() -> None:
    rows = [row("linear/h2", "b", c, 1.0, condition) for c in ("velocity", "current") for condition in ("load", "noload")]
    home, load = error_table(rows, "noload")
    assert (home.condition, load.condition) == ("noload", "load")
    assert home.ranked == {"velocity", "current"}
    assert load.ranked == {"velocity"}
    assert load.best("current", "mean") is None


def test_verdict_tells_the_numbers() -> None:
    text = " ".join(verdict(METRICS, ("position",)))
    assert "3 units of one batch were recorded (loaded and no load)." in text
    assert "“Koopman, worst-case H2”" in text
    assert "velocity to 0.300 % of the largest value (0.400 % on the worst unit, c)" in text
    told = {**METRICS["study"], "channels": {"velocity": "rad/s"}}  # type: ignore[dict-item]
    rows = [{**r, "rms": {"b": 0.01, "c": 0.03}.get(str(r["unit"]), 9.0)} for r in ROWS]
    text = " ".join(verdict({**METRICS, "study": told, "evaluation": rows}, ("position",)))
    assert "velocity to 0.300 % of the largest value (RMS 0.0200 rad/s; 0.400 % on the worst unit, c)" in text
    assert "Open loop, the nominal model alone, gives velocity 0.600 % (2.0 times as much)." in text
    assert "The best baseline is for velocity “Koopman, open loop”, 0.600 % (2.0 times as much)." in text
    assert "at most 12.0 % above" in text
    assert "No certificate could be found for it as it runs" in text


def test_verdict_compares_with_the_best_baseline_of_every_channel_by_name() -> None:
    errors = {
        "koopman/worst_case_h2": (0.2, 5.0),
        "linear/mixed": (0.1, 5.1),
        "learned": (0.19, None),
        "linear/kalman_tuned": (0.3, 4.0),
        "koopman/kalman_tuned": (0.4, 7.0),
        "filtered_difference": (0.25,),
        "mean_profile": (9.0, 4.5),
    }
    rows = [row(o, "b", c, e) for o, own in errors.items() for c, e in zip(("velocity", "current"), own, strict=False)]
    text = " ".join(verdict({**METRICS, "evaluation": rows}, ("position",)))
    told = "The best baseline is for velocity “learned”, 0.190 % (5 % less) and current “linear, tuned Kalman”, 4.00 % (20 % less)."
    assert told in text
    same = " ".join(verdict({**METRICS, "evaluation": rows, "left_out": {"rows": rows}}, ("position",)))
    assert same.count(told) == 2


def test_results_tell_what_baselines_are_not() -> None:
    facts = {
        "linear/kalman_tuned": {"status": "optimal", "correction_off": True},
        "koopman/kalman_tuned": {"status": "optimal", "correction_off": False},
        "learned": {"episodes": 30, "episodes_recorded": 47},
        "mean_profile": {"status": "failed", "reason": "Mean profile: no motion is repeated."},
    }
    off, learned, missing = baseline_notes(facts)
    assert off.endswith("training episodes: linear, tuned Kalman.")
    assert learned == "The learned estimator was trained on 30 of 47 training episodes, from their first sample on."
    assert missing == "Mean profile: no motion is repeated."
    assert baseline_notes({"learned": {"episodes": 47, "episodes_recorded": 47}})[0].startswith(
        "The learned estimator was trained on all 47"
    )
    assert baseline_notes({}) == []


def test_verdict_tells_of_units_that_were_left_out() -> None:
    rows = [row("koopman/worst_case_h2", unit, channel, e) for unit, e in (("b", 0.3), ("c", 0.5)) for channel in ("position", "velocity")]
    told = " ".join(verdict({**METRICS, "left_out": {"rows": rows}}, ("position",)))
    assert (
        "Designed without the unit it runs on, the same kind of observer estimates velocity to 0.400 % (0.500 % on the worst unit, c)"
        in told
    )
    rows[1]["error_percent"] = None
    assert "diverges on some units" in " ".join(verdict({**METRICS, "left_out": {"rows": rows}}, ("position",)))
    assert "Designed without" not in " ".join(verdict(METRICS, ("position",)))


def disturbed(kind: str, severity: float, mean: float | None) -> dict[str, object]:
    found = {"observer": "koopman/worst_case_h2", "disturbance": kind, "severity": severity, "condition": "noload", "channel": "velocity"}
    return {**found, "error_percent": {"mean": mean, "worst": mean}}


def test_verdict_says_what_sensor_is_needed() -> None:
    rows = [disturbed("none", 0.0, 1.0), disturbed("noise", 1e-4, 1.5), disturbed("noise", 1e-3, 2.0), disturbed("delay", 1, 40.0)]
    rows += [disturbed("bias", 1e-4, 1.0), disturbed("dropped", 0.1, 1.5), disturbed("dropped", 0.2, None)]
    text = "its error doubles with noise of 0.10 % of the largest value, a delay of less than 1 sample(s) that it is not told of or 20 % of the samples lost"
    assert f"Beyond the recordings' own sensor, {text}" in " ".join(verdict({**METRICS, "robustness": rows}, ("position",)))
    declared = {**METRICS, "study": {**METRICS["study"], "sensor": {"position": {"noise": 1.0}}}}  # type: ignore[dict-item]
    told = " ".join(verdict({**declared, "robustness": rows}, ("position",)))
    assert "Beyond the sensor that is declared" in told
    assert "on held-out episodes, as the declared sensor shows them, of units" in told
    assert "No noise, resolution" in " ".join(verdict({**METRICS, "robustness": [rows[0], rows[4]]}, ("position",)))
    assert "doubles" not in " ".join(verdict(METRICS, ("position",)))


def test_verdict_bounds_the_next_unit_or_says_why_not() -> None:
    bounds = {"velocity": {"error_percent": 0.04, "rms": 0.1}, "current": {"error_percent": 12.0, "rms": None}}
    found = {"reserve": 19, "confidence": 0.95, "condition": "noload", "bounds": bounds, "reason": None}
    told = (
        "With 95 % confidence it estimates velocity to 0.0400 % and current to 12.0 % or better on the next unit of the batch (no load): "
    )
    assert told + "19 units took part in nothing." in verdict({**METRICS, "next_unit": found})
    found |= {"bounds": None, "reason": "5 units in reserve, and a confidence of 0.95 needs 19"}
    assert f"Nothing is known with confidence about the next unit: {found['reason']}." in verdict({**METRICS, "next_unit": found})


@pytest.mark.parametrize("absent", ["evaluation", "observers", "outliers"])
def test_verdict_without_a_part(absent: str) -> None:
    text = " ".join(verdict({k: v for k, v in METRICS.items() if k != absent}))
    assert text.startswith("3 units")


def test_verdict_of_a_run_that_stopped_early() -> None:
    study = {k: v for k, v in METRICS["study"].items() if k != "deployed"}
    assert verdict({"schema": 1, "study": study})[-1] == "The run stopped before an observer was made."


def test_verdict_warns_of_a_diverging_observer() -> None:
    rows = [row("koopman/worst_case_h2", "b", "velocity", None)]
    assert "do not use it" in " ".join(verdict({**METRICS, "evaluation": rows}))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.4, "0.400"),
        (21.34, "21.3"),
        (-12.345, "−12.3"),
        (1234.5, "1234"),
        (123456.0, "1.23·10⁵"),
        (6.16e-5, "6.16·10⁻⁵"),
        (0.0, "0"),
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "–"),
    ],
)
def test_number(value: float | None, text: str) -> None:
    assert number(value) == text


def test_names_are_words() -> None:
    assert model_label("koopman_edmd") == "Koopman (EDMD)"
    assert model_label("linear") == "linear"
    assert observer_label("koopman/worst_case_h2") == "Koopman, worst-case H2"
    assert observer_label("filtered_difference") == "filtered difference"


def test_pairs_are_a_linear_and_a_koopman_observer() -> None:
    names = [
        f"{m}/{k}"
        for m in ("koopman", "linear", "koopman_edmd", "linear_edmd")
        for k in ("open_loop", "kalman_tuned", "mixed", "residual_h2")
    ]
    assert deployed_pair(names, "koopman/residual_h2") == ["linear/residual_h2", "koopman/residual_h2"]
    assert deployed_pair(names, None) == ["linear/mixed", "koopman/mixed"]
    assert deployed_pair(["linear_edmd/open_loop"], None) == ["linear_edmd/open_loop"]
    assert deployed_pair(["koopman/open_loop", "koopman/kalman_tuned", "koopman/mixed"], None) == ["koopman/kalman_tuned", "koopman/mixed"]
    assert paper_pair(names) == ["linear_edmd/mixed", "koopman_edmd/mixed"]
    assert paper_pair(["linear_edmd/mixed", "koopman/mixed"]) == ["linear_edmd/mixed"]
    assert paper_pair(["koopman/mixed", "learned"]) == []
    assert paper_pair([*names, "linear_edmd/paper", "koopman_edmd/paper"]) == ["linear_edmd/paper", "koopman_edmd/paper"]
    assert paper_pair([*names, "koopman_edmd/paper"]) == ["linear_edmd/mixed", "koopman_edmd/mixed"]


def test_koopman_and_linear_twins_differ_in_colour() -> None:
    for method in ("worst_case_h2", "mixed", "residual_h2"):
        assert observer_look(f"koopman/{method}").colour != observer_look(f"linear/{method}").colour


def test_best_models_prefer_our_own() -> None:
    assert best_models(["koopman_edmd", "linear_edmd", "koopman", "linear"]) == ["linear", "koopman"]
    assert best_models(["linear_edmd"]) == ["linear_edmd"]


def test_tones_are_unique_so_that_the_page_can_replace_them() -> None:
    assert len({t.light for t in Tone}) == len(Tone)
    assert len({t.variable for t in Tone}) == len(Tone)


def test_thinned_line_keeps_every_extreme_and_the_order() -> None:
    rng = np.random.default_rng(3)
    x, y = np.arange(20_000.0), rng.standard_normal(20_000)
    y[12_345], y[777] = 40.0, -40.0
    thin_x, thin_y = thin(x, y, 500)
    assert len(thin_x) <= 1000 + 500
    assert (thin_y.max(), thin_y.min()) == (40.0, -40.0)
    assert np.all(np.diff(thin_x) >= 0)
    assert np.array_equal(y[thin_x.astype(int)], thin_y)
    for block in range(10):  # what a column of pixels shows is the same
        part, kept = slice(block * 2000, (block + 1) * 2000), (thin_x >= block * 2000) & (thin_x < (block + 1) * 2000)
        assert (thin_y[kept].max(), thin_y[kept].min()) == (y[part].max(), y[part].min())


def test_short_lines_stay_as_they_are() -> None:
    x = np.arange(10.0)
    assert thin(x, x)[1] is x
    assert thin_log(x, x)[1] is x


def test_thinned_frequency_line_keeps_peaks() -> None:
    freqs, values = np.geomspace(1, 1e3, 5000), np.ones((2, 5000))
    values[1, 2501] = 7.0
    _, kept = thin_log(freqs, values, 100)
    assert kept.shape == (2, 100)
    assert kept[1].max() == 7.0
    assert kept[0].max() == 1.0


def test_spread_labels_do_not_overlap() -> None:
    places = spread([0.1, 0.1, 0.11, 0.5, 0.9], 0.1)
    assert np.all(np.diff(places) > 0.099)
    assert spread([0.2, 0.8], 0.1) == [0.2, 0.8]


@pytest.mark.parametrize(("low", "high"), [(0.3, 2.0), (1e-5, 0.1), (4.0, 60.0), (1.1, 1.9)])
def test_log_ticks_are_few_round_and_inside(low: float, high: float) -> None:
    ticks = log_ticks(low, high)
    assert len(ticks) <= 3
    assert all(low <= t <= high for t in ticks)
    assert all(f"{t:e}"[0] in "1235" for t in ticks)


def test_decibels() -> None:
    assert decibel([1.0, -10.0, 0.1j]) == pytest.approx([0.0, 20.0, -20.0])
    assert np.isnan(decibel([0.0])).all()
    assert power_of_ten(1e-12) == "10⁻¹²"
