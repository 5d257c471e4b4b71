"""The README's example runs as it stands there, and gives the observers of the study of the same recordings, byte for byte."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from csvs import write_csvs

import kros
from kros.data import write_parquet
from kros.design import Design
from kros.design.methods import suitable
from kros.identify import ModelSet
from kros.observer import Observer
from kros.plants import HarmonicDrivePopulation, PendulumPopulation
from kros.study import load_config
from kros.study import run as run_study
from kros.uncertainty import UncertainModels

ROOT = Path(__file__).parents[2]
ROLES = {
    "position": 'role = "state"\nmeasured = true',
    "target_position": 'role = "input"',
    "target_velocity": 'role = "input"',
}
pytestmark = pytest.mark.usefixtures("low_order_weights")
STATE = 'role = "state"'
# Methods that take long, for one kind of models each: what chooses among them is the same.
ONCE = {"estimator": "koopman", "worst_case_h2": "linear", "residual_h2": "koopman"}
LIFTING = "sin(100*position + phase)"
README_LIFTING = "sin(position)"


def write_csv(folder: Path) -> None:
    """Write a few drives as anybody's CSV files, and the mapping that says what is in them."""
    drives = HarmonicDrivePopulation(n_units=2, n_episodes=3, seconds=3.0, seed=2, conditions=("noload",))
    population = drives.simulate().population
    names = [c.name for c in population.channels]
    write_csvs(folder / "recordings", population, "{key.unit}/{key.episode}.csv", ",".join(["time", *names]))
    channels = [f'[[channel]]\nname = "{n}"\ncolumn = "{n}"\n{ROLES.get(n, STATE)}\n' for n in names]
    head = "files = '(?P<unit>[^/]+)/(?P<episode>[^/]+)\\.csv'\ntime = \"time\"\n"
    (folder / "mapping.toml").write_text(head + "".join(channels))
    tables = head.replace("files", "[data.csv]\nfiles") + "".join(channels).replace(
        "[[channel]]", "[[data.csv.channel]]"
    )
    (folder / "study.toml").write_text(
        f'[data]\nsource = "recordings"\nreader = "csv"\n{tables}\n[lifting]\nfunctions = ["{LIFTING}"]\n'
    )


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Run the README's lines in an empty folder, on fewer and shorter recordings, and stay there."""
    folder = tmp_path_factory.mktemp("short")
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert code is not None
    assert len(code.group(1).strip().splitlines()) <= 8
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("kros.plants.PendulumPopulation", partial(PendulumPopulation, 3, 3, 4.0))
        patch.setattr(
            import_module("kros.design.synthesize"),
            "suitable",
            lambda methods, kind: [m for m in suitable(methods, kind) if ONCE.get(m.name, kind) == kind],
        )
        exec(compile(code.group(1), "README.md", "exec"), names)
        assert np.isfinite(names["x_hat"])
        yield folder, names


@pytest.mark.slow
def test_the_short_way_is_the_study(example: tuple[Path, dict[str, Any]]) -> None:
    folder, names = example
    study = kros.run(names["population"], "runs/x", until="synthesize", lifting=[README_LIFTING])
    observers = folder / "runs" / "x" / "observers"
    assert without_study(observers / "deployed.json") == saved(names["design"], folder / "deployed.json")
    named = kros.synthesize(names["uncertain"], method="linear/worst_case_h2")
    assert without_study(observers / f"{named.name}.json") == saved(named, folder / "named.json")
    assert named.lower_bound == named.synthesis.lower_bound > 0
    other = replace(named.synthesis, worst_case_h2=None)
    # the optimum of another norm is no lower bound of the worst case
    assert replace(named, synthesis=other).lower_bound is None
    assert study.folder == Path("runs/x")


def saved(design: Design, path: Path) -> bytes:
    design.observer.save(path)
    return path.read_bytes()


def without_study(path: Path) -> bytes:
    """What a study wrote but for its name."""
    observer = Observer.load(path)
    replace(observer, about={k: v for k, v in observer.about.items() if k != "study"}).save(
        path.with_suffix(".unnamed")
    )
    return path.with_suffix(".unnamed").read_bytes()


def test_a_study_of_arrays_of_a_folder_and_of_a_file_is_the_same(tmp_path: Path) -> None:
    """Everything here is quick: EDMD models, few frequencies, and a Kalman filter."""
    folder = tmp_path
    write_csv(folder)
    population = kros.read(folder / "recordings", mapping=folder / "mapping.toml")
    quick: dict[str, Any] = {
        "identify": {"refine": False},
        "uncertainty": {"n_freqs": 50},
        "synthesis": {"methods": []},
        "observer": {"baselines": ["kalman_tuned"]},
    }
    file = [f"{table}.{key}={json.dumps(value)}" for table, keys in quick.items() for key, value in keys.items()]
    write_parquet(population, folder / "parquet")
    runs = [
        run_study(load_config(folder / "study.toml", file), folder / "a", until="synthesize"),
        kros.run(population, folder / "b", until="synthesize", lifting=[LIFTING], **quick),
        kros.run(folder / "parquet", folder / "c", until="identify", lifting=[LIFTING], **quick),
        kros.run(folder / "study.toml", folder / "d", until="identify", **quick),
    ]
    written = [without_study(run.folder / "observers" / "deployed.json") for run in runs[:2]]
    assert written[0] == written[1]
    # The others have the same models and settings, from which the rest follows.
    resolved = [json.loads((run.folder / "study.json").read_text()) for run in runs]
    models = [ModelSet.load(run.folder / "models" / "koopman_edmd") for run in runs]
    for settings, found in zip(resolved[1:], models[1:], strict=True):
        assert settings | dict.fromkeys(("name", "data")) == resolved[0] | dict.fromkeys(("name", "data"))
        np.testing.assert_array_equal(np.dstack([found.A, found.B]), np.dstack([models[0].A, models[0].B]))
    again = kros.run(population, folder / "b", until="synthesize", lifting=[LIFTING], **quick)
    before = runs[1].metrics["timing_s"]
    assert again.metrics["timing_s"]["identify"] == before["identify"]  # skipped: the arrays are the same


@pytest.mark.slow
def test_everything_is_saved_and_loaded(example: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    _, names = example
    names["design"].save(tmp_path / "design")
    design = Design.load(tmp_path / "design")
    assert design.name == names["design"].name
    assert design.certificate.gain == names["design"].certificate.gain
    names["uncertain"].save(tmp_path / "uncertain")
    uncertain = UncertainModels.load(tmp_path / "uncertain")
    assert repr(uncertain) == repr(names["uncertain"])
    same, first = (
        kros.synthesize(own, method="kalman_tuned", methods=()).synthesis.controller.D
        for own in (uncertain, names["uncertain"])
    )
    np.testing.assert_array_equal(same, first)
