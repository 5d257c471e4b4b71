"""One small demo run for all end-to-end tests, and the command line as people call it."""

from __future__ import annotations

import json
import os
import runpy
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from kros.design.methods import METHODS
from kros.design.methods.robust import Published, WorstCaseH2
from kros.report.figures import Drawn, draw
from kros.report.run_folder import RunFolder
from kros.uncertainty.settings import SET, QuantifySettings

# An estimator that learns from less: the keys of [estimator].
QUICK = """
rows = 4000
episodes = 16
sample = 1500
sample_episodes = 8
features = 8
folds = 2
parts = 2
gap_episodes = 4
gap_samples = 12000
penalties = [1e-12, 1e-8, 1e-4]
"""


@contextmanager
def low_orders() -> Iterator[None]:
    """Weights of low orders in studies that are about something else: fits take longest, and `tests/oracle` has them."""

    class First(QuantifySettings):
        max_order: int = 1

    methods = [replace(m, max_order=1) if isinstance(m, Published | WorstCaseH2) else m for m in METHODS]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("kros.uncertainty.quantify"), "QuantifySettings", First)
        patch.setattr(import_module("kros.uncertainty.unit_residuals"), "SET", replace(SET, entry_order=1))
        patch.setattr("kros.design.methods.METHODS", tuple(methods))
        yield


@contextmanager
def two_figures() -> Iterator[None]:
    """Reports have two figures, drawn in this process, where studies are about something else: drawing takes longest."""
    some = ("synthesis", "outlier_scores")

    def drawn(name: str, run: RunFolder) -> Drawn:
        return draw(name, run) if name in some else Drawn(name, name, reason="not asked for")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kros.report.html.draw", drawn)
        patch.setattr("kros.report.files.FIGURES", dict.fromkeys(some))
        yield


@pytest.fixture(scope="session")
def kros() -> Iterator[Callable[..., Result]]:
    """Call the command line in this process alone, unless workers are named; returns exit code and what is printed."""
    from kros.cli import app

    def call(*arguments: Any) -> Result:
        return CliRunner().invoke(app, [str(a) for a in arguments])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kros.cli._count", lambda workers: workers or 1)
        yield call


@pytest.fixture(scope="session")
def recorded(kros, tmp_path_factory) -> Path:
    """Simulated recordings: five units and an outlier, two conditions, four short episodes."""
    out = tmp_path_factory.mktemp("recorded") / "recordings"
    result = kros("simulate", out, "--units", 5, "--episodes", 4, "--seconds", 8, "--outlier")
    assert result.exit_code == 0, result.output
    return out


@pytest.fixture(scope="session")
def pendulums(kros, tmp_path_factory) -> Path:
    """Recordings of four pendulums."""
    folder = tmp_path_factory.mktemp("pendulums") / "recordings"
    assert kros("simulate", folder, "--plant", "pendulum", "--units", 4, "--episodes", 3, "--seconds", 5).exit_code == 0
    return folder


@pytest.fixture(scope="session")
def demo(kros, recorded, tmp_path_factory) -> Path:
    """A finished study, with fewer rows and points; `tests/e2e/test_report.py` draws all its figures."""
    folder = tmp_path_factory.mktemp("demo")
    few = '[observer]\nbaselines = ["open_loop", "filtered_difference", "learned", "mean_profile"]\n'
    quick = f'[estimator]\n{QUICK}[uncertainty]\nn_freqs = 100\n[synthesis]\nmethods = ["worst_case_h2", "estimator"]\n'
    (folder / "demo.toml").write_text(f'[data]\nsource = "{recorded}"\nreader = "parquet"\n{few}{quick}')
    with two_figures():
        result = kros("run", folder / "demo.toml", "--out", folder / "run")
    assert result.exit_code == 0, result.output
    return folder / "run"


@pytest.fixture(scope="session")
def paper(kros, recorded, tmp_path_factory) -> Path:
    """A study of the same recordings with the paper's models and observers."""
    folder = tmp_path_factory.mktemp("paper")
    few = '[synthesis]\nmethods = ["mixed", "paper"]\n[observer]\nbaselines = ["open_loop"]\n[uncertainty]\nn_freqs = 60\n'
    (folder / "paper.toml").write_text(
        f'[data]\nsource = "{recorded}"\nreader = "parquet"\n[identify]\nrefine = false\n{few}'
    )
    with low_orders(), two_figures():
        result = kros("run", folder / "paper.toml", "--out", folder / "run")
    assert result.exit_code == 0, result.output
    return folder / "run"


@pytest.fixture(scope="session")
def metrics(demo) -> dict[str, Any]:
    """The demo's machine-readable result."""
    return json.loads((demo / "metrics.json").read_text())


@pytest.fixture(scope="module")
def low_order_weights() -> Iterator[None]:
    """Weights of low orders in all studies of a file."""
    with low_orders():
        yield


@pytest.fixture(scope="module")
def few_figures() -> Iterator[None]:
    """Two figures in all reports of a file."""
    with two_figures():
        yield


@pytest.fixture
def example(monkeypatch, capsys) -> Callable[..., str]:
    """Run a script of the examples in this process; returns what it prints."""

    def run(script: str, *options: Any, data: Path | None = None, fails: str | None = None) -> str:
        monkeypatch.setitem(os.environ, "KROS_DATA", str(data)) if data else monkeypatch.delenv("KROS_DATA", False)
        monkeypatch.setattr(sys, "argv", [script, *map(str, options)])
        ended = None
        try:
            runpy.run_path(str(Path(__file__).parents[2] / "examples" / script), run_name="__main__")
        except SystemExit as end:
            ended = end.code or None
        printed = capsys.readouterr()
        assert (fails in str(ended)) if fails else ended is None, printed.err
        return printed.out

    return run


@pytest.fixture
def study(recorded, tmp_path) -> Callable[..., Path]:
    """Write a study file on the demo's recordings, with more TOML behind it."""

    def write(extra: str = "", source: Path | None = None, reader: str = "parquet") -> Path:
        path = tmp_path / "study.toml"
        path.write_text(f'[data]\nsource = "{source or recorded}"\nreader = "{reader}"\n{extra}\n')
        return path

    return write
