"""The ways through the code that `docs/architecture.md` draws are those that it goes, and CONTRIBUTING.md names what there is."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

import kros
from kros.data.prepare import with_gaps
from kros.design import Design
from kros.observer import Observer
from kros.study.commands.field import FieldRecordings
from kros.synthesis import ObserverProblem, Synthesis
from kros.uncertainty.quantify import UncertainModels

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
SAMPLES = 1009  # of the recording; nothing else has as many rows
# Of the estimator, which goes the same way with more.
FEW = {"rows": 3000, "sample": 1000, "folds": 2, "parts": 2, "gap_samples": 300}
MOST = {"recording": 7, "worst_case_h2": 6, "estimator": 6}  # packages on a way


@contextmanager
def traced(sought: Callable[[Any], bool]) -> Iterator[list[str]]:
    """Modules whose functions return something that holds what is sought, in order; `core` is used by all."""
    modules: list[str] = []

    def look(frame: FrameType, event: str, value: Any) -> None:
        name = frame.f_globals.get("__name__", "")
        if event != "return" or frame.f_code.co_name.endswith("comp>"):  # a comprehension is a function in 3.11 alone
            return
        if re.match(r"kros\.(?!core)", name) and holds(value, sought):
            modules.append(name.removeprefix("kros."))

    sys.setprofile(look)
    try:
        yield modules
    finally:
        sys.setprofile(None)


def holds(value: Any, sought: Callable[[Any], bool], depth: int = 3) -> bool:
    """Tell whether something that is sought is in a value."""
    parts: Iterable[Any] = value.values() if isinstance(value, dict) else ()
    if isinstance(value, list | tuple):
        parts = value
    if is_dataclass(value):
        parts = [getattr(value, field.name, None) for field in fields(value)]
    return sought(value) or (depth > 0 and any(holds(part, sought, depth - 1) for part in parts))


def is_recording(value: Any) -> bool:
    """Tell whether a value is an array of the samples of the recording."""
    return isinstance(value, np.ndarray) and SAMPLES in value.shape


def is_design(value: Any) -> bool:
    """Tell whether a value is a design, or what one is made of."""
    return isinstance(value, ObserverProblem | Synthesis | Observer | Design)


def packages(modules: list[str]) -> list[str]:
    """The packages of modules, each once in a row."""
    folders = (
        name if (ROOT / "src/kros" / name.replace(".", "/")).is_dir() else name.rpartition(".")[0] for name in modules
    )
    return [name for name, _ in groupby(folders)]


@pytest.fixture(scope="module")
def uncertain() -> UncertainModels:
    """Models of three motors."""
    motors = kros.plants.DcMotorPopulation(n_units=3, n_episodes=2, seconds=1.0, seed=3).simulate().population
    return kros.quantify(kros.identify(motors, refine=False), n_freqs=50, max_order=1)


def recorded(folder: Path, population: kros.data.Population) -> kros.data.Population:
    """One recording in a file of its own, opened as `kros estimate` opens it."""
    values = np.resize(population.read(population.episodes[0]), (SAMPLES, len(population.channels)))
    with (folder / "a_1.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *(channel.name for channel in population.channels)])
        rows.writerows([round(k * population.sample_period_s, 9), *row] for k, row in enumerate(values))
    channels = [
        {"name": c.name, "role": c.role.value, "measured": c.measured, "column": c.name} for c in population.channels
    ]
    mapping = {"files": r"(?P<unit>[a-z]+)_(?P<episode>\d)[.]csv", "time": "t", "channel": channels}
    return with_gaps(kros.read(folder, "csv", mapping))


@pytest.fixture(scope="module")
def ways(uncertain: UncertainModels, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Modules on every way, in order."""
    found: dict[str, list[str]] = {}
    for method in ("worst_case_h2", "estimator"):
        with traced(is_design) as found[method]:
            design = kros.synthesize(uncertain, method, methods=(), estimator=FEW)
    folder = tmp_path_factory.mktemp("recording")
    with traced(is_recording) as found["recording"]:
        population = recorded(folder, uncertain.models.population)
        found["recording"].clear()
        recordings = FieldRecordings(design.observer, population, {"a": {}})
        assert sum(len(columns) for _, _, columns, *_ in recordings.estimates()) == SAMPLES
    return found


@pytest.mark.parametrize("way", MOST)
def test_ways_are_as_drawn(way: str, ways: dict[str, list[str]]) -> None:
    """In the order in which packages first hand on what is on its way."""
    (drawn,) = re.findall(rf"^{way}: (.+)$", PAGE, flags=re.MULTILINE)
    assert drawn.split(" → ") == list(dict.fromkeys(packages(ways[way])))
    assert len(drawn.split(" → ")) <= MOST[way]


def test_files_and_returns_are_counted(ways: dict[str, list[str]]) -> None:
    stated = re.findall(r"^\| `(\w+)` \| (\d+) \| (\d+) \| (\d+) \|$", PAGE, flags=re.MULTILINE)
    counts = []
    for way in MOST:
        steps = packages(ways[way])
        counts.append((way, str(len(set(steps))), str(len(set(ways[way]))), str(len(steps) - len(set(steps)))))
    assert stated == counts


def places() -> list[tuple[str, str]]:
    """Names and files of the table of changes."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.split("| to change | go to |")[1].split("\n\n")[0]
    return re.findall(r"`(\w+)` in `([\w/.]+)`", table)


@pytest.mark.parametrize(("name", "file"), places())
def test_places_of_changes_exist(name: str, file: str) -> None:
    text = (ROOT / "src/kros" / file).read_text(encoding="utf-8")
    assert re.search(rf"^ *(?:class|def|static void) {name}\b|^{name}\b.* = ", text, flags=re.MULTILINE)


def test_every_change_has_a_place() -> None:
    names = "WeightSettings start EstimatorSettings initial begin _table errors_of METHODS SynthesisSettings"
    assert [name for name, _ in places()] == names.split()


def test_the_order_of_weights_has_one_default() -> None:
    numbers = {
        path.relative_to(ROOT / "src/kros").as_posix(): count
        for path in (ROOT / "src/kros/uncertainty").rglob("*.py")
        if (count := len(re.findall(r"max_order: int.* = (?:Field\()?\d", path.read_text(encoding="utf-8"))))
    }
    assert numbers == {"uncertainty/settings.py": 1}
