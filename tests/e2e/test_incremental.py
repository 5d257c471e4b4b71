"""Runs whose recordings grew or changed: what is new is computed, and the result is that of a fresh run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from run_results import results

import kros
from kros.core.work import Work
from kros.study import Stage, validate_config
from kros.study import run as run_study


@pytest.fixture(scope="module")
def drives(tmp_path_factory) -> Path:
    """Three drives in the raw layout, in two conditions."""
    folder = tmp_path_factory.mktemp("drives") / "raw"
    simulated = kros.plants.HarmonicDrivePopulation(n_units=3, n_episodes=3, seconds=4.0, seed=5).simulate()
    kros.data.readers.motor_drive_raw.write_raw(simulated.raw, folder)
    return folder


@pytest.fixture
def computed(monkeypatch) -> dict[str, list[str]]:
    """Which units each map computes, by its name."""
    found: dict[str, list[str]] = {}

    def counted(self: Work, title: str, function: Callable[..., Any], tasks: Sequence[Any]) -> Any:
        tasks = list(tasks)
        own = [task for _, task in tasks]  # behind its digest
        populations = [task[0] if isinstance(task, tuple) else task.population for task in own]
        found.setdefault(title, []).extend(population.unit_ids[0] for population in populations)
        return map(function, tasks)

    monkeypatch.setattr(Work, "map", counted)
    return found


def study(source: Path, out: Path, **identify: Any) -> Path:
    """Run a study up to its models."""
    content = {"name": "grown", "data": {"source": str(source)}, "identify": {"refine": False, **identify}}
    content["data"]["reader"] = "motor-drive-raw"
    return run_study(validate_config(content, source), out, until=Stage.IDENTIFY).folder


def folders(raw: Path) -> list[Path]:
    """Folders of the recordings of one drive in one condition."""
    return sorted(p for p in raw.glob("batch_b/population/*"))


def without(raw: Path, out: Path, *left_out: Path) -> Path:
    """Copy recordings, with their times, but for some files or folders."""
    shutil.copytree(
        raw, out, ignore=lambda place, names: [n for n in names if any(Path(place) / n == p for p in left_out)]
    )
    return out


def put_back(raw: Path, out: Path) -> None:
    """Copy what is not there."""
    for path in sorted(p for p in raw.rglob("*") if p.is_file()):
        target = out / path.relative_to(raw)
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, target)


def fresh(source: Path, tmp_path: Path, **identify: Any) -> dict[str, Any]:
    """Return the results of a run that knows nothing."""
    return results(study(source, tmp_path / "fresh", **identify))


@pytest.mark.parametrize(
    ("new", "read", "load"),
    [("*_001003_*", ["001003"] * 2, ["001003"]), ("*_001002_noload/*2.csv", ["001002"], [])],
    ids=["a unit", "an episode"],
)
def test_of_what_is_new_its_unit_alone_is_computed(drives, tmp_path, computed, new, read, load):
    last = list(drives.glob(f"batch_b/population/{new}"))
    assert len(last) == len(read)
    source = without(drives, tmp_path / "raw", *last)
    run = study(source, tmp_path / "run")
    put_back(drives, source)
    computed.clear()
    study(source, run)
    assert computed == {"read": read, "calibrate": read[:1], "identify (noload)": read[:1], "identify (load)": load}
    assert results(run) == fresh(source, tmp_path)


def test_a_file_that_changed_is_noticed_and_one_that_was_only_touched_is_only_read(drives, tmp_path, computed):
    source = without(drives, tmp_path / "raw")
    run = study(source, tmp_path / "run")
    touched, changed = (sorted(p.iterdir())[0] for p in folders(source)[:4:2])
    os.utime(touched, ns=(1, 1))
    rows = changed.read_text().splitlines()
    changed.write_text("\n".join(rows[:-1]) + "\n")  # a sample less
    computed.clear()
    study(source, run)
    units = [p.parent.name.split("_")[1] for p in (touched, changed)]
    assert computed["read"] == units
    assert computed["calibrate"] + computed["identify (noload)"] + computed["identify (load)"] != []
    assert set(computed["calibrate"] + computed["identify (noload)"] + computed["identify (load)"]) == {units[1]}
    assert results(run) == fresh(source, tmp_path)


def test_a_unit_that_is_gone_leaves_nothing_behind(drives, tmp_path, computed):
    source = without(drives, tmp_path / "raw")
    run = study(source, tmp_path / "run")
    for folder in folders(source)[:2]:
        shutil.rmtree(folder)
    computed.clear()
    study(source, run)
    assert not any(computed.values())
    assert results(run) == fresh(source, tmp_path)


def test_another_regularisation_or_lifting_takes_from_earlier_runs_what_does_not_depend_on_it(
    drives, tmp_path, computed
):
    run = study(drives, tmp_path / "run")
    computed.clear()
    study(drives, run, alpha=90.0)
    assert computed == {"identify (noload)": [], "identify (load)": []}
    assert results(run) == fresh(drives, tmp_path, alpha=90.0)
    content = {
        "name": "grown",
        "data": {"source": str(drives), "reader": "motor-drive-raw"},
        "identify": {"refine": False, "alpha": 90.0},
    }
    content |= {"lifting": {"functions": ["cos(100*position + phase)"]}}
    computed.clear()
    run_study(validate_config(content, drives), run, until=Stage.IDENTIFY)
    assert [len(units) for units in computed.values()] == [0, 3, 3]  # the phase is known, the factors are others


@pytest.mark.parametrize("damage", ["changed", "recordings"])
def test_what_is_damaged_is_computed_again(drives, tmp_path, computed, damage):
    source = without(drives, tmp_path / "raw", folders(drives)[0])
    run = study(source, tmp_path / "run")
    put_back(drives, source)
    copies = sorted((run / "recordings").glob("*.parquet"))
    kept = next(path for path in (run / "store").glob("*.npz") if b'"digests"' in path.read_bytes())
    if damage == "recordings":
        copies[0].write_bytes(b"something else")
        copies[1].unlink()
    else:
        whole = kept.read_bytes()
        kept.write_bytes(whole[:200] + bytes(200) + whole[400:])
    computed.clear()
    study(source, run)
    assert len(computed["read"]) == (3 if damage == "recordings" else 2)
    assert results(run) == fresh(source, tmp_path)
