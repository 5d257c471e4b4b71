"""The page, figures as files and plots, on a small run folder written by the classes that the stages use."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.figure import Figure
from scipy.signal import welch
from tests.support.browser import printed_pages, probe

from kros.core.artifacts import save_artifact, write_json
from kros.core.errors import ConfigError, DataError
from kros.core.lti import StateSpace, gain
from kros.data import from_arrays
from kros.data.population import Channel, EpisodeKey, Population, Role, Unit
from kros.data.survey import RecordingFacts
from kros.design import Design
from kros.evaluate import standard_disturbances
from kros.identify import ModelSet, PhaseCalibration, PhaseSpec
from kros.identify.calibration import UnitPhase
from kros.identify.identified import IdentifiedModels
from kros.lifting import Lifting
from kros.observer import Observer
from kros.report import plot, render, write_figures
from kros.report.figures import FIGURES, draw, draw_all
from kros.report.figures.entries import beside, entry_names
from kros.report.figures.synthesis import scaled_filter
from kros.report.figures.uncertainty import published_bounds
from kros.report.files import to_svg
from kros.report.names import observer_label
from kros.report.plotting import PLOTS
from kros.report.run_folder import RunFolder
from kros.study.pipeline import RunResult
from kros.synthesis.result import Injection, Status, Synthesis
from kros.uncertainty import Form, OutlierModel, UncertainModel, quantify, score_outliers
from kros.uncertainty.quantify import UncertainModels
from kros.uncertainty.unit_residuals import UnitResiduals

DT = 0.001
UNITS = ("000000", "001", "002", "003", "0<b>4")
STATES = ("position", "velocity", "current")
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("current", Role.STATE, "1"),
    Channel("target_position", Role.INPUT, "rad"),
    Channel("target_velocity", Role.INPUT, "rad/s"),
)
DEPLOYED = "koopman_edmd/worst_case_h2"
METHODS = ("open_loop", "kalman_tuned", "mixed", "worst_case_h2")
Array = npt.NDArray[np.float64]


def models(name: str, condition: str, seed: int) -> ModelSet:
    """Stable models of five units that differ by a few percent; the first differs by more."""
    rng = np.random.default_rng(seed)
    lifting = (
        Lifting(STATES, ("sin(100*position + phase)",), ("phase",)) if name.startswith("koopman") else Lifting(STATES)
    )
    n, m = lifting.n_lifted, 2
    base = 0.9 * np.eye(n) + 0.02 * rng.standard_normal((n, n))
    spread = np.array([0.2, 0.01, 0.02, 0.03, 0.02])[:, None, None]
    A = base + 0.02 * spread * rng.standard_normal((5, n, n))
    B = 0.1 * rng.standard_normal((n, m)) * (1 + spread * rng.standard_normal((5, n, m)))
    parameters = {"phase": np.linspace(0.1, 5.0, 5)} if lifting.parameters else {}
    covariance = np.broadcast_to(np.eye(n), (5, n, n))
    return ModelSet(
        name,
        condition,
        lifting,
        CHANNELS,
        DT,
        UNITS,
        A,
        B,
        parameters,
        covariance,
        np.full(n, 2.0),
        np.full(m, 3.0),
        90.0,
        ("ok",) * 5,
    )


@pytest.fixture(scope="session")
def uncertain() -> dict[str, UncertainModel]:
    found = {}
    for name in ("koopman_edmd", "linear_edmd"):
        found[name] = quantify(
            models(name, "noload", 1), freqs_hz=np.geomspace(0.1, 500, 60), unit_ids=UNITS[1:], max_order=2
        )
    return found


def synthesis(n: int, method: str) -> Synthesis:
    bound = 0.8 if method == "worst_case_h2" else None
    return Synthesis(
        method,
        gain(np.full((n, 1), 0.25), DT),
        Status.CERTIFIED,
        Injection.STATE,
        worst_case_h2=1.0 if bound else None,
        lower_bound=bound,
    )


def shown_signals(seed: int) -> tuple[Array, Array]:
    """Six seconds, forward and back at constant speed with an oscillation at 50 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(6000) * DT
    speed = np.pi * np.where(t < 3, 1.0, -1.0) * (np.minimum(np.minimum(t % 3, 3 - t % 3), 0.2) / 0.2)
    position = np.cumsum(speed) * DT
    velocity = speed + 0.02 * np.sin(100 * position) + 1e-4 * rng.standard_normal(t.size)
    current = 0.2 * np.tanh(speed) + 0.02 * np.sin(100 * position)
    return np.column_stack([position, velocity, current]), np.column_stack([position, speed])


def write_read_stage(run: Path) -> None:
    write_json(run / "study.json", {"name": "tiny & small", "data": {"reader": "parquet"}})
    groups = {u: "outliers" if u == "000000" else "population" for u in UNITS}
    keys = [[u, c, "1"] for u in UNITS for c in ("load", "noload")]
    facts = {
        "recordings": "recordings",
        "identify_on": "noload",
        "groups": groups,
        "train": keys,
        "test": keys,
        "resolution": {"position": 1e-6},
    }
    save_artifact(run / "population", "facts", {**facts, "dropped": []})


def write_models(run: Path, uncertain: dict[str, UncertainModel]) -> None:
    phases = {u: UnitPhase(0.5 * i, -0.9 - 0.01 * i, 0.99 - 0.1 * (i == 2), 12) for i, u in enumerate(UNITS)}
    PhaseCalibration(PhaseSpec(), -0.9, phases).save(run / "calibration")
    for name in uncertain:
        models(name, "noload", 1).save(run / "models" / name)
        models(name, "load", 2).save(run / "models" / f"{name}@load")
        uncertain[name].save(run / "uncertainty" / name)
    save_artifact(run / "uncertainty", "choice", {"nominal": "001", "worst_off_nominal": "002", "dropped": []})
    write_diagnostics(run, uncertain)
    rows = [
        {
            "unit": u,
            "condition": c,
            "score": 9.0 if (u, c) == ("000000", "load") else -2.0,
            "threshold": 5.0,
            "outlier": (u, c) == ("000000", "load"),
        }
        for u in UNITS
        for c in ("load", "noload")
    ]
    write_json(run / "outliers" / "scores.json", {"schema": 1, "rows": rows})


def scores(condition: str) -> OutlierModel:
    found = models("koopman_edmd", condition, 1 if condition == "noload" else 2)
    freqs = np.geomspace(0.1, 400.0, 40)
    return score_outliers(
        found.systems().frequency_response(freqs),
        freqs,
        unit_ids=UNITS,
        output_scale=found.output_scale,
        input_scale=found.input_scale,
    )


def beside_others(name: str) -> UnitResiduals:
    found = models(name, "load", 2)
    covered = quantify(found, freqs_hz=np.geomspace(0.1, 500, 40), unit_ids=UNITS[1:], max_order=2)
    inside = beside(covered, found)
    outer = (
        np.concatenate([3 * inside.entries[:1], inside.entries]),
        np.concatenate([3 * inside.ratio[:1], inside.ratio]),
    )
    return dataclasses.replace(inside, unit_ids=UNITS, outside=UNITS[:1], entries=outer[0], ratio=outer[1])


def write_diagnostics(run: Path, uncertain: dict[str, UncertainModel]) -> None:
    for name, model in uncertain.items():
        beside(model, models(name, "noload", 1)).save(run / "uncertainty" / name / "units")
        beside_others(name).save(run / "outliers" / f"{name}@load" / "others")
    for condition, folder in (("noload", "koopman_edmd"), ("load", "koopman_edmd@load")):
        scores(condition).save(run / "outliers" / folder)


def write_observers(run: Path) -> list[str]:
    names = [f"{m}/{k}" for m in ("koopman_edmd", "linear_edmd") for k in METHODS]
    for name in names:
        kind, method = name.split("/")
        found = models(kind, "noload", 1)
        result = synthesis(found.lifting.n_lifted, method)
        result.save(run / "synthesis" / name)
        observer = Observer(
            name, found.lifting, found.A[1], found.B[1], (0,), found.inputs, result.controller, Injection.STATE, DT
        )
        observer.save(run / "observers" / f"{name}.json")
        if name == DEPLOYED:
            observer.save(run / "observers" / "deployed.json")
    facts: dict[str, Any] = {
        n: {"order": 0, "spectral_radius_max": 0.99, "worst_case_h2": 1.0 + i} for i, n in enumerate(names)
    }
    save_artifact(run / "observers", "observers", {"names": names, "deployed": DEPLOYED, "facts": facts})
    return names


def write_evaluation(run: Path, names: list[str]) -> list[dict[str, Any]]:
    rng = np.random.default_rng(5)
    kinds = ["koopman_edmd", "linear_edmd"]
    shown = [["001", "noload", "1"], ["002", "noload", "1"], ["001", "load", "1"]]
    arrays: dict[str, Array] = {"freqs_hz": np.linspace(0, 500, 257)}
    for number in range(len(shown)):
        states, inputs = shown_signals(number)
        arrays |= {f"shown{number}/states": states, f"shown{number}/inputs": inputs}
        for name in names:
            arrays[f"shown{number}/observer/{name}"] = states + 1e-3 * rng.standard_normal(states.shape)
        for kind in kinds if number < 2 else []:
            arrays[f"shown{number}/model/{kind}"] = states + 1e-3 * rng.standard_normal(states.shape)
    for kind in kinds:
        arrays[f"spectrum/model/{kind}"] = rng.uniform(1e-6, 1e-4, (257, 3))
    for name in names:
        for role in ("nominal", "off_nominal"):
            for condition in ("load", "noload"):
                arrays[f"spectrum/{role}/{condition}/{name}"] = rng.uniform(1e-6, 1e-4, (257, 3))
    arrays["shown0/observer/linear_edmd/mixed"][3000:] = np.inf  # an estimate that diverges
    roles = dict(zip(UNITS, ["outlier", "nominal", "off_nominal", "off_nominal", "off_nominal"], strict=True))
    rows = [
        {
            "observer": n,
            "unit": u,
            "role": roles[u],
            "condition": c,
            "channel": x,
            "rms": 0.1,
            "error_percent": None if n.endswith("mixed") else 1.0 + i,
        }
        for i, n in enumerate(names)
        for u in UNITS
        for c in ("load", "noload")
        for x in STATES
    ]
    free = {k: {c: {"median": 1.0 + i, "worst": 2.0 + i} for c in STATES} for i, k in enumerate(kinds)}
    content = {
        "rows": rows,
        "free_run": free,
        "band_hz": [45.0, 55.0],
        "roles": roles,
        "shown": shown,
        "observers": names,
        "models": kinds,
    }
    save_artifact(run / "evaluation", "evaluation", {**content, "states": STATES}, arrays)
    return rows


def write_left_out(run: Path, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Every unit left out once, half as well estimated; one observer diverges."""
    held = [
        {**row, "fold": 0, "error_percent": row["error_percent"] and 2 * row["error_percent"]}
        for row in rows
        if row["role"] != "outlier"
    ]
    facts = {"made": 2, "orders": [2, 3], "relift_certified": 2, "robust": 1, "reasons": []}
    content = {
        "folds": [["001"], ["002"]],
        "failed": {},
        "rows": held,
        "observers": {row["observer"]: facts for row in rows},
    }
    save_artifact(run / "left_out", "left_out", content)
    return content


def write_disturbed(run: Path, names: list[str]) -> dict[str, Any]:
    """Every disturbance, with one observer that diverges, and a histogram for one."""
    told = [("none", 0.0), *((d.kind.value, d.severity) for d in standard_disturbances())]
    robustness = [
        {
            "observer": n,
            "disturbance": kind,
            "severity": severity,
            "condition": "noload",
            "channel": c,
            "error_percent": {"mean": None, "worst": None}
            if n.endswith("mixed") and severity
            else {"mean": 1 + severity, "worst": 2 + severity},
        }
        for n in names
        for kind, severity in told
        for c in STATES
    ]
    content = {"robustness": robustness}
    save_artifact(run / "disturbed", "disturbed", {**content, "units": ["001"], "seconds": 3.0})
    return content


@pytest.fixture(scope="session")
def finished(
    tmp_path_factory: pytest.TempPathFactory, uncertain: dict[str, UncertainModel]
) -> tuple[Path, dict[str, Any]]:
    """A finished run and its metrics."""
    run = tmp_path_factory.mktemp("run")
    write_read_stage(run)
    write_models(run, uncertain)
    names = write_observers(run)
    rows = write_evaluation(run, names)
    entry = {
        "nominal": "001",
        "form": "inverse_input_multiplicative",
        "peak_db": {f.value: -10.0 for f in Form},
        "misfit_max": 0.02,
        "weight": {"structure": "diagonal", "orders": [[1, 2], [2, 0]], "cover_max": 0.999, "overbound_db_max": 1.2},
    }
    metrics = {
        **early_metrics(),
        **write_disturbed(run, names),
        "left_out": write_left_out(run, rows),
        "models": {
            k: {"order": 4, "spectral_radius_max": 0.99, "freerun_error_percent": {}}
            for k in ("koopman_edmd", "linear_edmd")
        },
        "uncertainty": {k: entry for k in ("koopman_edmd", "linear_edmd")},
        "observers": {
            n: {"order": 0, "status": "certified", "worst_case_h2": 1.0, "spectral_radius_max": 0.99} for n in names
        }
        | {"linear_edmd/hinf": {"status": "failed", "reason": "a reason; a reason; another"}},
        "calibration": {"ratio": 100.0, "angle": "position", "parameter": "phase", "lag_rad": -0.9},
        "evaluation": rows,
        "outliers": [{"unit": u, "condition": "load", "score": 1.0, "outlier": u == "000000"} for u in UNITS],
    }
    metrics["study"] = {**metrics["study"], "deployed": DEPLOYED}
    return run, metrics


def early_metrics() -> dict[str, Any]:
    study = {"units": 4, "conditions": ["load", "noload"], "identify_on": "noload", "sample_period_s": DT}
    study |= {"channels": {c.name: c.unit for c in CHANNELS}, "measured": ["position"]}
    return {
        "schema": 1,
        "study": study,
        "timing_s": {"read": 1.0},
        "units": [{"unit": u, "group": "", "status": "ok"} for u in UNITS],
    }


@pytest.fixture(scope="session")
def page(finished: tuple[Path, dict[str, Any]]) -> str:
    return render(*finished).read_text(encoding="utf-8")


class Outline(HTMLParser):
    """Collects what a browser would load, and checks that tags are balanced."""

    VOID = frozenset({"meta", "br", "link", "img"})

    def __init__(self) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._note(tag, attrs)
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._note(tag, attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.stack
        assert self.stack.pop() == tag

    def _note(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("href", "xlink:href", "src"):
                self.links.append(value or "")


def outline(page: str) -> Outline:
    parser = Outline()
    parser.feed(page)
    assert parser.stack == []
    return parser


def test_page_stands_alone(page: str) -> None:
    found = outline(page)
    assert all(link.startswith("#") for link in found.links)
    assert not found.tags & {"link", "img", "iframe"}
    assert "@import" not in page
    assert re.findall(r"url\((?!#)", page) == []
    assert len(page) < 6_000_000


def test_identifiers_are_unique_and_references_lead_somewhere(page: str) -> None:
    found = outline(page)
    assert len(set(found.ids)) == len(found.ids)
    assert {link[1:] for link in found.links} | set(re.findall(r"url\(#([^)]*)\)", page)) <= set(found.ids)


def test_every_section_has_at_most_one_figure_with_a_caption(page: str) -> None:
    sections = re.findall(r'<section id="([^"]*)".*?</section>', page, flags=re.DOTALL)
    assert len(sections) == len(set(sections)) > 10
    for part in re.findall(r"<section .*?</section>", page, flags=re.DOTALL):
        assert part.count("<figure") == part.count("<figcaption") <= 1
    assert page.count("<figure") == 9
    assert all(f">{word}<" in page for word in ("Errors", "Units", "Certificates"))


def test_words_of_the_verdict(page: str) -> None:
    assert '<p class="status"><span class="lamp" aria-hidden="true"></span>NOT READY</p>' in page
    assert "can be deployed" not in page
    assert "not tried" not in page
    assert "The certificates do not hold if" in page


_LOOK = """
const folded = page.documentElement.scrollHeight, details = [...page.querySelectorAll("details")];
details.forEach(one => { one.removeAttribute("name"); one.open = true; });
const cut = [...page.querySelectorAll(".wide")].filter(
  one => one.querySelector("table") && one.scrollWidth > one.clientWidth + 1);
const table = page.querySelector("#errors table.sortable");
const column = () => [...table.tBodies[0].rows].map(row => row.cells[2].dataset.value ?? "");
const button = table.querySelector("thead tr:last-child th:nth-child(3) button");
const [first, second] = [0, 1].map(() => { button.click(); return column(); });
const field = page.querySelector("#errors input");
field.value = "kalman no"; field.dispatchEvent(new Event("input"));
const shown = [...table.tBodies[0].rows].filter(row => !row.hidden).map(row => row.textContent.toLowerCase());
const unnamed = [...page.querySelectorAll("svg[role=img], nav, input, button")].filter(
  one => !(one.getAttribute("aria-label") || one.textContent.trim() || one.closest("label")));
const mark = page.querySelector("figure use[data-unit]");
mark.scrollIntoView({ block: "center", inline: "center" });
const box = mark.getBoundingClientRect(), at = { clientX: box.x + box.width / 2, clientY: box.y + box.height / 2 };
mark.closest("svg").dispatchEvent(new frame.PointerEvent("pointermove", at));
const tip = page.querySelector(".tip"), near = page.querySelectorAll(".near").length;
const wide = mark.closest(".wide"), before = mark.closest("svg").getBoundingClientRect().width;
wide.click();
const zoomed = mark.closest("svg").getBoundingClientRect().width / before;
return { tip: tip.hidden ? "" : tip.textContent, near, zoomed, folded,
  overflow: page.documentElement.scrollWidth - width, cut: cut.map(one => one.textContent.trim().slice(0, 60)),
  first, second, shown, unnamed: unnamed.length, units: page.querySelectorAll("svg [data-unit]").length };
"""


def test_page_in_a_browser(page: str, tmp_path: Path) -> None:
    found, console = probe(page, _LOOK, [1400, 900, 390], tmp_path)
    assert console == []
    for width, seen in found.items():
        assert (seen["overflow"], seen["cut"], seen["unnamed"]) == (0, [], 0), width
        known = [[float(text) for text in order if text] for order in (seen["first"], seen["second"])]
        assert known[0] == sorted(known[0])
        assert known[1] == known[0][::-1]
        assert known[0][0] < known[0][-1]
        assert 0 < len(seen["shown"]) < len(seen["first"])
        assert all("kalman" in text and "no" in text for text in seen["shown"])
        assert seen["units"] > 0
        assert seen["tip"] in UNITS
        assert seen["near"] > 1  # the same unit in other figures
        assert seen["zoomed"] > 1.2
    assert found["1400"]["folded"] <= 4000
    assert printed_pages(page, tmp_path) <= 12


def test_lines_and_points_carry_the_names_of_their_units(finished: tuple[Path, dict[str, Any]], page: str) -> None:
    assert 'data-unit="0&lt;b&gt;4"' in page
    assert "units-" not in "".join(re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL))
    drawn = draw("phase", RunFolder(finished[0]))
    svg = to_svg(drawn.figure, "phase")
    marks = dict(re.findall(r'<use data-unit="([^"]*)"[^>]* x="([\d.]+)"', svg.replace("\n", " ")))
    order = [unit.replace("<", "&lt;").replace(">", "&gt;") for unit in UNITS]
    assert sorted(marks, key=lambda unit: float(marks[unit])) == order  # the horizontal axis is units in order


def test_text_is_escaped(page: str) -> None:
    assert "0<b>4" not in page
    assert "0&lt;b&gt;4" in page
    assert "<h1>tiny &amp; small</h1>" in page


def test_diverged_and_failed_observers_are_named(page: str) -> None:
    assert "diverged" in page
    assert "a reason; another" in page
    assert "a reason; a reason" not in page


def test_a_part_of_a_run_has_a_report(tmp_path: Path) -> None:
    write_read_stage(tmp_path)
    text = render(tmp_path, early_metrics()).read_text(encoding="utf-8")
    outline(text)
    assert "<figure" not in text
    assert "stopped before an observer was designed" in text
    assert "NOT READY" in text
    assert all(result.figure is None and result.reason for result in draw_all(RunFolder(tmp_path)))


def test_broken_artifact_is_an_error(tmp_path: Path) -> None:
    write_read_stage(tmp_path)
    (tmp_path / "evaluation").mkdir()
    (tmp_path / "evaluation" / "evaluation.json").write_text("{")
    with pytest.raises(DataError, match="not valid JSON"):
        render(tmp_path, early_metrics())
    assert not (tmp_path / "report.html").exists()


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """Leave out most figures, for speed."""
    chosen = ("phase", "forms", "observers_in_time")
    monkeypatch.setattr("kros.report.figures.FIGURES", {name: FIGURES[name] for name in chosen})
    return chosen


def test_figures_as_files(finished: tuple[Path, dict[str, Any]], tmp_path: Path, few: tuple[str, ...]) -> None:
    names = write_figures(finished[0], tmp_path / "new" / "figures")
    assert len(names) == 2 * len(few)
    for name in names:
        content = (tmp_path / "new" / "figures" / name).read_bytes()
        assert content.startswith(b"\x89PNG" if name.endswith("png") else b"%PDF")
    with pytest.raises(ConfigError, match="is a file"):
        write_figures(finished[0], tmp_path / "new" / "figures" / names[0])


@pytest.mark.usefixtures("few")
def test_same_run_gives_the_same_figures(finished: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    first, second = ([(tmp_path / n / f).read_bytes() for f in write_figures(finished[0], tmp_path / n)] for n in "ab")
    assert first == second
    drawn = [[to_svg(r.figure, r.name) for r in draw_all(RunFolder(finished[0])) if r.figure] for _ in range(2)]
    assert drawn[0] == drawn[1]


def test_observer_figures_show_nominal_above_worst_off_nominal_and_the_errors(
    finished: tuple[Path, dict[str, Any]],
) -> None:
    run = RunFolder(finished[0])
    pair = ["linear_edmd/mixed", "koopman_edmd/mixed"]
    rows = np.reshape(draw("observers_in_time_paper", run).figure.axes, (6, 4))
    titles = [axes.get_title("left") for axes in rows[::3, 0]]
    assert titles == ["nominal: unit 001, episode 1", "worst off-nominal: unit 002, episode 1"]
    assert [line.get_label() for line in rows[0, 0].lines] == ["recorded", *map(observer_label, pair)]
    shown = run.shown[1]
    error = shown.states[:, 1] - shown.observers[pair[1]][:, 1]
    line = rows[4, 2].lines[1]  # velocity of the worst unit, Koopman
    assert np.isin(line.get_ydata(), error).all()
    density = welch(error, 1 / DT, "hann", 512)[1][1:]
    assert rows[4, 3].lines[1].get_ydata() == pytest.approx(density, rel=1e-9)
    assert len(rows[1, 2].lines) == 1  # an estimate that diverges has no error in scale
    other = np.reshape(draw("loaded_paper", run).figure.axes, (3, 4))
    error = run.shown[2].states[:, 0] - run.shown[2].observers[pair[1]][:, 0]
    assert other[0, 3].lines[1].get_ydata() == pytest.approx(welch(error, 1 / DT, "hann", 512)[1][1:], rel=1e-9)


def test_magnitude_and_phase_of_all_units(finished: tuple[Path, dict[str, Any]]) -> None:
    figure = draw("models", RunFolder(finished[0])).figure
    found = models("koopman_edmd", "noload", 1)
    row = figure.axes[:4]
    assert [axes.get_title("left").split("\n")[1] for axes in row] == ["magnitude (dB)", "phase (°)"] * 2
    freqs, unit = row[0].lines[0].get_xdata(), found.index("001")
    response = found.scaled_responses(freqs, ["001"])[0, :, 0, 1]
    assert row[2].lines[0].get_label() == f"nominal, unit {UNITS[unit]}"
    assert row[2].lines[0].get_ydata() == pytest.approx(20 * np.log10(np.abs(response)))
    assert np.exp(1j * np.radians(row[3].lines[0].get_ydata())) == pytest.approx(response / np.abs(response))


def test_plot_takes_every_result(uncertain: dict[str, UncertainModel]) -> None:
    population = from_arrays({"a": [np.zeros((50, 5)) + np.arange(50.0)[:, None]]}, CHANNELS, sample_period_s=DT)
    before = dict(matplotlib.rcParams)
    some = (population, models("koopman_edmd", "noload", 1), uncertain["linear_edmd"], synthesis(4, "mixed"))
    for result in (*some, scores("load")):
        figure = plot(result)
        assert isinstance(figure, Figure)
        assert figure.axes
        figure.canvas.draw()
    assert dict(matplotlib.rcParams) == before
    with pytest.raises(ConfigError, match="got a int"):
        plot(3)


def test_drawing_leaves_pyplot_alone() -> None:
    code = (
        "import sys; from kros.core.lti import gain; import kros.report; assert 'matplotlib' not in sys.modules;"
        "from kros.synthesis.result import Status, Synthesis;"
        "kros.report.plot(Synthesis('h2', gain([[1.0]], 0.1), Status.OPTIMAL));"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_output_forms_of_the_paper_never_fall_below_one(uncertain: dict[str, UncertainModel]) -> None:
    found = published_bounds(uncertain["koopman_edmd"], models("koopman_edmd", "noload", 1))
    assert set(found) == {Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE}
    assert all(np.all(bound > 1 - 1e-9) for _, bound in found.values())


def test_entries_have_the_names_of_their_signals(uncertain: dict[str, UncertainModel]) -> None:
    model, found = uncertain["koopman_edmd"], models("koopman_edmd", "noload", 1)
    own = beside(model, found)
    assert own.largest.shape[1:] == tuple(len(names) for names in entry_names(model.form, found))


def test_filter_is_scaled_by_the_ranges() -> None:
    found = models("linear_edmd", "noload", 1)
    K = StateSpace([[0.5]], [[1.0]], [[1.0], [2.0]], [[0.0], [0.0]], DT)
    into_inputs = scaled_filter(Synthesis("mixed", K, Status.OPTIMAL, Injection.INPUT), found)
    # innovation of range 2 over the pole at one half, correction of range 3
    assert into_inputs.frequency_response([0.0])[0, :, 0] == pytest.approx([2 / 0.5 / 3, 4 / 0.5 / 3])


def test_every_class_that_can_be_plotted_has_its_figure() -> None:
    for name, place in PLOTS.items():
        module, _, function = place.partition(":")
        assert callable(getattr(import_module(f"kros.report.figures.{module}".rstrip(".")), function)), name
    observer = Observer(
        "linear/h2",
        Lifting(STATES),
        np.eye(3),
        np.ones((3, 2)),
        (0,),
        ("u", "v"),
        gain(0.1 * np.ones((3, 1)), DT),
        Injection.STATE,
        DT,
    )
    assert [line.get_label() for line in plot(observer).axes[0].lines] == [f"position → {name}" for name in STATES]


def test_a_run_is_plotted_by_any_figure_of_its_report(finished: tuple[Path, dict[str, Any]]) -> None:
    run = RunResult(finished[0], finished[1], ())
    assert len(plot(run).axes) == 16
    assert len(plot(run, name="phase").axes) == 3
    with pytest.raises(ConfigError, match="declares no load"):
        plot(run, name="load_torque")
    with pytest.raises(ConfigError, match="no figure 'beauty'"):
        plot(run, name="beauty")


def test_results_of_the_short_way_are_plotted(uncertain: dict[str, UncertainModel]) -> None:
    keys = [EpisodeKey(unit, "noload", "1") for unit in UNITS]
    signals = np.hstack(shown_signals(0))
    population = Population(CHANNELS, DT, tuple(Unit(u) for u in UNITS), tuple(keys), lambda key: signals)
    facts = RecordingFacts("noload", {u: "" for u in UNITS}, tuple(keys), tuple(keys), {})
    kind = "linear_edmd"
    found = IdentifiedModels(population, facts, Lifting(STATES), None, (kind,), {kind: models(kind, "noload", 1)})
    assert len(plot(found).axes) == len(STATES) * 4
    sets = UncertainModels(found, "001", "002", {kind: uncertain[kind]})
    assert len(plot(sets).axes) == 4
    assert len(plot(sets, entries=True).axes) == 4
    with pytest.raises(ConfigError, match="no set of kind 'koopman'"):
        plot(sets, kind="koopman")
    made = synthesis(len(STATES), "h2")
    own = found.models()
    observer = Observer(
        f"{kind}/h2", own.lifting, own.A[1], own.B[1], (0,), own.inputs, made.controller, Injection.STATE, DT
    )
    design = Design(
        observer.name, observer, made, SimpleNamespace(certified=True, gain=2.0), {"hidden_error_percent": 1.0}
    )
    assert any(text.get_text() == "certified" for text in plot(design).axes[2].texts)
    drawn = plot(design, models=found).axes[4].lines
    assert [line.get_label() for line in drawn] == ["recorded", observer_label(observer.name)]
    assert drawn[0].get_ydata().max() == pytest.approx(signals[:, 1].max())
