"""The page, figures as files and plots: the demo's run, with metrics in which names are hostile and observers fail."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from browser import printed_pages, probe
from matplotlib.figure import Figure
from scipy.signal import welch

import kros as package
from kros.core.artifacts import save_artifact, write_json
from kros.core.errors import ConfigError, DataError
from kros.report.figures import FIGURES, draw
from kros.report.figures.uncertainty import entry_names, published_bounds
from kros.report.files import write_figures
from kros.report.html import render
from kros.report.manifest import Artefact, describe, write_manifest
from kros.report.names import observer_label
from kros.report.run_folder import RunFolder
from kros.study.pipeline import RunResult
from kros.uncertainty import Form
from kros.uncertainty.quantify import residuals_beside_weights

HOSTILE, LOST = "0<b>4", "linear/worst_case_h2"


@pytest.fixture(scope="module")
def run(demo) -> RunFolder:
    return RunFolder(demo)


@pytest.fixture(scope="module")
def page(demo, metrics, tmp_path_factory) -> str:
    """The report with a unit of a hostile name, an observer that diverges, and one that could not be designed."""
    unit = next(row["unit"] for row in metrics["units"] if row["group"] != "outliers")
    changed = json.loads(json.dumps(metrics).replace(f'"unit": "{unit}"', f'"unit": "{HOSTILE}"'))
    for row in changed["evaluation"]:
        row["error_percent"] = None if row["observer"] == LOST else row["error_percent"]
    changed["observers"]["linear/hinf"] = {"status": "failed", "reason": "a reason; a reason; another"}
    out = tmp_path_factory.mktemp("page") / "report.html"
    return render(demo, changed, out=out).read_text(encoding="utf-8")


class Outline(HTMLParser):
    """Collects what a browser would load, and checks that tags are balanced."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.stack, self.ids, self.links, self.tags = [], [], [], set()
        self.feed(page)
        assert self.stack == []

    def handle_starttag(self, tag, attrs) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in {"meta", "br", "link", "img"}:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs) -> None:
        self.tags.add(tag)
        self.ids += [value for name, value in attrs if name == "id"]
        self.links += [value for name, value in attrs if name in ("href", "xlink:href", "src")]

    def handle_endtag(self, tag) -> None:
        assert self.stack.pop() == tag


def test_page_stands_alone_and_its_references_lead_somewhere(page) -> None:
    outline = Outline(page)
    assert all(link.startswith("#") for link in outline.links)
    assert not outline.tags & {"link", "img", "iframe"}
    assert "@import" not in page
    assert re.findall(r"url\((?!#)", page) == []
    assert len(page) < 6_000_000
    assert len(set(outline.ids)) == len(outline.ids)
    assert {link[1:] for link in outline.links} | set(re.findall(r"url\(#([^)]*)\)", page)) <= set(outline.ids)


def test_every_section_has_at_most_one_figure_with_a_caption(page) -> None:
    sections = re.findall(r'<section id="([^"]*)".*?</section>', page, flags=re.DOTALL)
    assert len(sections) == len(set(sections)) > 8
    for part in re.findall(r"<section .*?</section>", page, flags=re.DOTALL):
        assert part.count("<figure") == part.count("<figcaption") <= 1
    assert all(f">{word}<" in page for word in ("Errors", "Units", "Certificates"))
    assert "The certificates do not hold if" in page


def test_hostile_names_are_text_and_failures_are_named(page) -> None:
    assert HOSTILE not in page
    assert "0&lt;b&gt;4" in page
    assert "diverged" in page
    assert "a reason; another" in page
    assert "a reason; a reason" not in page


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
field.value = "open no"; field.dispatchEvent(new Event("input"));
const shown = [...table.tBodies[0].rows].filter(row => !row.hidden).map(row => row.textContent.toLowerCase());
const unnamed = [...page.querySelectorAll("svg[role=img], nav, input, button")].filter(
  one => !(one.getAttribute("aria-label") || one.textContent.trim() || one.closest("label")));
const picture = page.querySelector("figure svg"), before = picture.getBoundingClientRect().width;
picture.closest(".wide").click();
const zoomed = picture.getBoundingClientRect().width / before;
return { zoomed, folded,
  overflow: page.documentElement.scrollWidth - width, cut: cut.map(one => one.textContent.trim().slice(0, 60)),
  first, second, shown, unnamed: unnamed.length };
"""


def test_page_in_a_browser(page, tmp_path) -> None:
    found, console = probe(page, _LOOK, [1400, 900, 390], tmp_path)
    assert console == []
    for width, seen in found.items():
        assert (seen["overflow"], seen["cut"], seen["unnamed"]) == (0, [], 0), width
        known = [[float(text) for text in order if text] for order in (seen["first"], seen["second"])]
        assert known[0] == sorted(known[0])
        assert known[1] == known[0][::-1]
        assert known[0][0] < known[0][-1]
        assert 0 < len(seen["shown"]) < len(seen["first"])
        assert all("open" in text and "no" in text for text in seen["shown"])
        assert seen["zoomed"] > 1.2
    assert found["1400"]["folded"] <= 4400  # with all checks and failures of this page
    assert printed_pages(page, tmp_path) <= 16


def write_read_stage(folder: Path) -> dict:
    """A run that only read its recordings; returns its metrics."""
    write_json(folder / "study.json", {"name": "tiny & small", "data": {"reader": "parquet"}})
    keys = [["a", "noload", "1"]]
    facts = {"recordings": "recordings", "identify_on": "noload", "groups": {"a": "population"}, "dropped": []}
    save_artifact(folder / "population", "facts", facts | {"train": keys, "test": keys, "resolution": {"x": 1e-6}})
    study = {"units": 1, "conditions": ["noload"], "identify_on": "noload", "sample_period_s": 1e-3}
    study |= {"channels": {"x": "rad"}, "measured": ["x"]}
    return {"schema": 1, "study": study, "units": [{"unit": "a", "group": "", "status": "ok"}]}


def test_a_part_of_a_run_has_a_report(tmp_path) -> None:
    metrics = write_read_stage(tmp_path)
    text = render(tmp_path, metrics).read_text(encoding="utf-8")
    Outline(text)
    assert "<h1>tiny &amp; small</h1>" in text
    assert "<figure" not in text
    assert "stopped before an observer was designed" in text
    assert "NOT READY" in text
    assert all((drawn := draw(name, RunFolder(tmp_path))).figure is None and drawn.reason for name in FIGURES)
    name = "evaluation/shown/0/shown.json"
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).write_text("{")
    files = {name: describe(tmp_path / name), "population/facts.json": describe(tmp_path / "population" / "facts.json")}
    write_manifest(tmp_path, {"evaluate": Artefact(digest=64 * "0", files=files)})
    (tmp_path / "report.html").unlink()
    with pytest.raises(DataError, match="not valid JSON"):
        render(tmp_path, metrics)
    assert not (tmp_path / "report.html").exists()


def test_figures_as_files_are_the_same_every_time(demo, tmp_path, monkeypatch) -> None:
    few = ("phase", "outlier_scores")
    monkeypatch.setattr("kros.report.files.FIGURES", {name: FIGURES[name] for name in few})
    files = []
    for folder in (tmp_path / "new" / "a", tmp_path / "new" / "b"):
        names = write_figures(demo, folder)
        assert len(names) == 2 * len(few)
        files.append([(folder / name).read_bytes() for name in names])
    assert files[0] == files[1]
    assert all(content.startswith((b"\x89PNG", b"%PDF")) for content in files[0])
    with pytest.raises(ConfigError, match="is a file"):
        write_figures(demo, tmp_path / "new" / "a" / names[0])


def test_observers_of_the_paper_are_named_so_and_belong_to_its_models(run, paper) -> None:
    assert "identify.refine = false" in draw("observers_in_time_paper", run).reason
    assert "as published" not in (run.folder / "report.html").read_text(encoding="utf-8")
    page = (paper / "report.html").read_text(encoding="utf-8")
    assert "as published" in page
    assert "Koopman (EDMD), mixed, entrywise weights" in page
    assert "Refined models" not in page


def test_observer_figures_show_nominal_above_worst_off_nominal_and_the_errors(paper) -> None:
    pair, run = ["linear_edmd/paper", "koopman_edmd/paper"], RunFolder(paper)
    rows = np.reshape(draw("observers_in_time_paper", run).figure.axes, (6, 4))
    titles = [axes.get_title("left").partition(":")[0] for axes in rows[::3, 0]]
    assert titles == ["nominal", "worst off-nominal"]
    assert [line.get_label() for line in rows[0, 0].lines] == ["recorded", *map(observer_label, pair)]
    other = np.reshape(draw("loaded_paper", run).figure.axes, (3, 4))
    for axes, shown, state in ((rows[4], run.shown[1], 1), (other[0], run.shown[2], 0)):
        error = shown.states[:, state].astype(float) - shown.observers[pair[1]][:, state].astype(float)
        assert np.isin(axes[2].lines[1].get_ydata(), error).all()
        density = welch(error, 1 / run.sample_period_s, "hann", 512)[1][1:]
        assert axes[3].lines[1].get_ydata() == pytest.approx(density, rel=1e-6)


def test_output_forms_of_the_paper_never_fall_below_one_and_entries_have_names(run) -> None:
    model, models = run.uncertain["koopman"], run.models["koopman"]
    bounds = published_bounds(model, models)
    assert set(bounds) == {Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE}
    assert all(np.all(bound > 1 - 1e-9) for _, bound in bounds.values())
    sizes = tuple(len(names) for names in entry_names(model.form, models))
    assert residuals_beside_weights(models, model).largest.shape[1:] == sizes


def test_results_of_the_short_way_are_plotted(demo, metrics) -> None:
    motors = package.plants.DcMotorPopulation(n_units=3, n_episodes=3, seconds=1.0, seed=3).simulate().population
    models = package.identify(motors, refine=False)
    uncertain = package.quantify(models, n_freqs=50, max_order=1)
    design = package.synthesize(uncertain, "kalman_tuned", methods=())
    before = dict(matplotlib.rcParams)
    for result in (motors, models, uncertain, next(iter(uncertain.sets.values())), RunResult(demo, metrics)):
        figure = result.plot()
        assert isinstance(figure, Figure)
        assert figure.axes
    assert dict(matplotlib.rcParams) == before
    drawn = design.plot(models=models).axes[4].lines
    assert [line.get_label() for line in drawn] == ["recorded", observer_label(design.observer.name)]
    run = RunResult(demo, metrics)
    assert len(run.plot(name="phase").axes) == 3
    assert run.summary().startswith("RunResult\n")
    for wrong, options, match in (
        (run, {"name": "beauty"}, "no figure 'beauty'"),
        (uncertain, {"model": "koopman"}, "there are none, only linear_edmd"),
        (design, {}, "give models="),
        (models, {"kind": "beauty"}, "no figure of kind 'beauty'; choose one of bode, compare"),
        (motors, {"size": 3}, "no option size; 'recorded' has unit, condition"),
    ):
        with pytest.raises((ConfigError, DataError), match=match):
            wrong.plot(**options)


def test_drawing_leaves_pyplot_alone() -> None:
    code = (
        "import sys, kros, kros.report; assert 'matplotlib' not in sys.modules;"
        "motors = kros.plants.DcMotorPopulation(n_units=1, n_episodes=1, seconds=1.0).simulate().population;"
        "motors.plot(); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_runs_are_compared_as_table_and_json(kros, demo, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(demo, other)
    study = json.loads((other / "study.json").read_text())
    study["evaluate"]["reserve"] += 1
    (other / "study.json").write_text(json.dumps(study))
    result = kros("compare", demo, other)
    assert result.exit_code == 0, result.output
    assert re.search(r"evaluate.reserve +\d+ +\d+", result.stdout)
    content = json.loads(kros("compare", demo, other, "--json").stdout)
    assert content["runs"] == [demo.name, "other"]
    assert set(content["settings"]) == {"evaluate.reserve"}
    assert content["errors in percent"] == {}


def test_what_cannot_be_compared_is_refused(kros, demo, tmp_path):
    for runs, text in (([demo], "at least two runs"), ([demo, tmp_path], "there is no study.json")):
        result = kros("compare", *runs)
        assert result.exit_code == 2
        assert text in result.stderr
    begun = tmp_path / "begun"
    shutil.copytree(demo, begun)
    (begun / "metrics.json").unlink()
    assert "has not ended" in kros("compare", demo, begun).stderr
