"""The run folder: what its manifest lists, what a run may remove, who may work in it, and what an interrupted run leaves."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from run_results import files, results

from kros.core.errors import IdentificationError
from kros.report.manifest import recorded_files
from kros.study import load_config
from kros.study import run as run_study
from kros.study.engine.lock import NAME as LOCK
from kros.study.engine.lock import locked
from kros.study.stages import learning

pytestmark = pytest.mark.usefixtures("few_figures")
FAST = (
    'name = "fast"\n[data]\nsource = "{source}"\nreader = "parquet"\n'
    "[identify]\nrefine = false\n"
    "[uncertainty]\nn_freqs = 60\n"
    '[synthesis]\nmethods = ["residual_h2"]\n'
    '[observer]\nbaselines = ["open_loop", "kalman_tuned"]\n'
)


@pytest.fixture(scope="module")
def fast(pendulums, tmp_path_factory) -> Path:
    """A quick study."""
    path = tmp_path_factory.mktemp("fast") / "fast.toml"
    path.write_text(FAST.format(source=pendulums))
    return path


@pytest.fixture(scope="module")
def finished(fast, few_figures) -> Path:
    """A finished run, which no test changes."""
    run_study(load_config(fast, ["evaluate.folds=2"]), fast.parent / "finished")
    return fast.parent / "finished"


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A copy of the finished run."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def again(kros: Callable[..., Any], fast: Path, run: Path, *options: Any) -> Any:
    return kros("run", fast, "--out", run, "--set", "evaluate.folds=2", *options)


def digest(run: Path, stage: str) -> str:
    return json.loads((run / "manifest.json").read_text())["artefacts"][stage]["digest"]


def test_manifests_list_every_file_of_a_run_and_no_other(finished):
    free = {"manifest.json", "study.json", "metrics.json"}
    assert recorded_files(finished) == {name for name in files(finished) if not name.startswith("store/")} - free
    assert any(name.startswith("observers/relift/") for name in recorded_files(finished))
    assert any(name.startswith("left_out/1/observers/relift/") for name in recorded_files(finished))


def test_the_store_holds_what_manifests_name_and_no_other(finished):
    manifests = [json.loads(path.read_text()) for path in finished.rglob("manifest.json")]
    named = {about["digest"] for manifest in manifests for about in manifest["artefacts"].values()}
    folders = {path.name for path in (finished / "store").iterdir() if path.is_dir()}
    assert folders == named
    artefacts = [json.loads(path.read_text()) for path in (finished / "store").glob("*/artefact.json")]
    results = {name for artefact in artefacts for name in artefact["results"]}
    assert results == {path.stem for path in (finished / "store").glob("*.npz")} != set()


@pytest.mark.parametrize("pattern", ["observers/relift/*/*/relift.json", "left_out/1/models/*/arrays.npz"])
def test_any_file_that_was_changed_is_made_again(kros, fast, run, finished, pattern):
    changed = sorted(run.glob(pattern))[0]
    name = changed.relative_to(run).as_posix()
    content = bytearray(changed.read_bytes())
    content[len(content) // 2] ^= 1
    changed.write_bytes(content)
    report = kros("report", run)
    assert report.exit_code == 2
    assert name in report.stderr
    assert again(kros, fast, run, "--until", "left_out").exit_code == 0
    assert results(run)[name] == results(finished)[name]


def test_a_stage_may_run_many_times_in_one_folder(kros, fast, run):
    for _ in range(2):
        shutil.rmtree(run / "store" / digest(run, "quantify"))
        assert again(kros, fast, run, "--until", "quantify", "--set", "uncertainty.n_freqs=61").exit_code == 0
    assert recorded_files(run) >= {name for name in files(run) if name.startswith(("uncertainty/", "outliers/"))}


def test_a_stage_that_fails_leaves_the_earlier_run_as_it_was(kros, fast, run, finished, monkeypatch):
    def fails(*args, **options):
        raise IdentificationError("two units are needed")

    with monkeypatch.context() as patched:
        patched.setattr(learning, "quantify", fails)
        assert again(kros, fast, run, "--set", "uncertainty.n_freqs=61").exit_code == 1
    assert results(run) == results(finished)
    assert kros("figures", run, run.parent / "figures").exit_code == 0


def test_another_study_is_refused_and_the_same_one_may_change(kros, fast, run, pendulums, tmp_path):
    before = results(run)
    other = tmp_path / "other.toml"
    other.write_text(FAST.format(source=pendulums).replace('"fast"', '"slow"'))
    elsewhere = tmp_path / "elsewhere.toml"
    shutil.copytree(pendulums, tmp_path / "recordings")
    elsewhere.write_text(FAST.format(source=tmp_path / "recordings"))
    for study in (other, elsewhere):
        found = kros("run", study, "--out", run)
        assert found.exit_code == 2
        assert "holds the study 'fast'" in found.stderr
        assert results(run) == before
    assert kros("demo", "--out", run).exit_code == 2
    assert results(run) == before


def crafted(run: Path, names: list[str], matching: Path | None = None) -> None:
    """Let the manifest claim other files of a stage, with the right digest where one is given."""
    import hashlib

    path = run / "manifest.json"
    manifest = {key: about for key, about in json.loads(path.read_text()).items() if key != "checksum"}
    content = hashlib.sha256(matching.read_bytes()).hexdigest() if matching else "0" * 64
    manifest["artefacts"]["synthesize"]["files"] |= dict.fromkeys(names, (content, 0, 0))
    manifest["artefacts"]["synthesize"]["digest"] = "0" * 64
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "name",
    ["{victim}", "../victim/thesis.tex", "linked/thesis.tex", "link", "models/../../victim/thesis.tex"],
    ids=["absolute", "above", "link to a folder", "link", "above in the middle"],
)
def test_a_manifest_cannot_reach_out_of_its_folder(kros, fast, run, tmp_path, name):
    victim = tmp_path / "victim" / "thesis.tex"
    victim.parent.mkdir()
    victim.write_text("years of work")
    (run / "linked").symlink_to(victim.parent)
    (run / "link").symlink_to(victim)
    crafted(run, [name.format(victim=victim)], victim)
    found = again(kros, fast, run, "--until", "synthesize")
    assert found.exit_code in (0, 2), found.output
    assert victim.read_text() == "years of work"
    assert (run / "linked").is_symlink()
    assert (run / "link").is_symlink()


def test_files_of_others_in_a_run_folder_stay(kros, fast, run):
    for name in ("notes.txt", "observers/notes.txt", "left_out/0/notes.txt"):
        (run / name).write_text("remember")
    crafted(run, ["notes.txt"])
    assert kros("run", fast, "--out", run, "--until", "synthesize", "--set", "identify.alpha=90").exit_code == 0
    assert {"notes.txt", "observers/notes.txt", "left_out/0/notes.txt"} <= files(run)
    assert not any(name.startswith("left_out/") for name in files(run) - {"left_out/0/notes.txt"})


def test_a_damaged_manifest_is_written_again_from_the_store(kros, fast, run, finished):
    for content in ("[]", '{"read": 3}', "null", "", "{", '{"read": {"digest": 5}}'):
        (run / "manifest.json").write_text(content)
        assert kros("report", run).exit_code == 2, content
        if content.startswith("{"):
            found = again(kros, fast, run)
            assert found.exit_code == 0, content
            assert found.stderr.count("unchanged") >= 8
            assert recorded_files(run) == recorded_files(finished)


@pytest.mark.parametrize("name", ["artefact.json", "models/models.json"])
def test_a_damaged_artefact_is_computed_again_and_no_other(kros, fast, run, finished, name):
    place = run / "store" / digest(run, "identify")
    (place / name).write_text("{")
    found = again(kros, fast, run)
    assert found.exit_code == 0
    assert found.stderr.count("unchanged") >= 7
    assert results(run) == results(finished)


def test_a_link_in_the_place_of_a_folder_of_results_is_not_followed(kros, fast, run, tmp_path):
    (tmp_path / "outside").mkdir()
    shutil.rmtree(run / "uncertainty")
    (run / "uncertainty").symlink_to(tmp_path / "outside")
    found = again(kros, fast, run, "--until", "quantify")
    assert found.exit_code == 2
    assert "link" in found.stderr
    assert not list((tmp_path / "outside").iterdir())


def test_leftovers_are_not_believed(kros, run, finished, pendulums, fast):
    known = kros("check", run, pendulums, "--json")
    assert kros("report", run).exit_code == 0
    page = (run / "report.html").read_bytes()
    for kind in ("models", "uncertainty", "outliers", "synthesis"):
        for folder in sorted((run / kind).glob("*")) if (run / kind).is_dir() else ():
            if folder.is_dir():
                shutil.copytree(folder, run / kind / f"{folder.name}_ghost")
    assert kros("report", run).exit_code == 0
    assert (run / "report.html").read_bytes() == page
    assert kros("list", run).exit_code == kros("compare", finished, run).exit_code == 0
    assert kros("check", run, pendulums, "--json").stdout == known.stdout
    found = again(kros, fast, run)
    assert found.stderr.count("unchanged") >= 8


def test_a_second_run_is_refused_while_the_first_lives(kros, fast, run, pendulums, tmp_path):
    before = results(run)
    with locked(run):
        for command in (
            ("run", fast, "--out", run),
            ("report", run),
            ("check", run, pendulums),
            ("figures", run, tmp_path / "figures"),
            ("estimate", run, pendulums, tmp_path / "estimate.parquet"),
        ):
            found = kros(*command)
            assert found.exit_code == 2, command
            assert f"process {os.getpid()}" in found.stderr
        assert {k: v for k, v in results_of(run).items() if k != LOCK} == before
    with locked(run, shared=True):
        assert kros("check", run, pendulums).exit_code in (0, 3, 4)
        assert again(kros, fast, run).exit_code == 2
    (run / LOCK).write_text("process 1 on moon, since long ago,")  # left by one that was killed
    assert again(kros, fast, run).exit_code == 0
    assert results(run) == before


def results_of(folder: Path) -> dict[str, Any]:
    """As `results`, beside a lock that is held."""
    held = (folder / LOCK).read_text()
    assert held
    kept = shutil.copytree(folder, folder.parent / "while_locked", ignore=shutil.ignore_patterns(LOCK))
    return results(Path(kept))


def test_a_copy_of_a_run_that_may_only_be_read_is_as_good(kros, run, pendulums, tmp_path):
    moved = run.rename(tmp_path / "moved")
    for path in moved.rglob("*"):
        os.utime(path)
    moved.chmod(0o555)
    try:
        assert kros("estimate", moved, pendulums, tmp_path / "estimate.parquet").exit_code == 0
    finally:
        moved.chmod(0o755)


def test_a_deployed_observer_that_was_changed_is_not_run(kros, run, pendulums, tmp_path):
    path = run / "observers" / "deployed.json"
    content = json.loads(path.read_text())
    content["model"]["A"][0][0] = None
    path.write_text(json.dumps(content))
    for command in (("estimate", run, pendulums, tmp_path / "estimate.parquet"), ("check", run, pendulums)):
        found = kros(*command)
        assert found.exit_code == 2
        assert "observers/deployed.json" in found.stderr
    assert not (tmp_path / "estimate.parquet").exists()


def start(fast: Path, run: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from kros.cli import app; app()", "run", str(fast), "--out", str(run), *options]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def wait_for(found: Callable[[], Any], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not found():
        assert time.monotonic() < end
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Descendants of a process."""
    own = [int(c) for task in Path(f"/proc/{pid}/task").glob("*/children") for c in task.read_text().split()]
    return own + [c for child in own for c in children(child)]


def lives(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_a_run_that_is_stopped_leaves_no_workers_and_resumes(kros, fast, finished, tmp_path):
    run = tmp_path / "run"
    process = start(fast, run, "--workers", "2", "--until", "synthesize")
    begun = "population/facts.json"  # early: a busy machine may be late
    wait_for(lambda: begun in (recorded_files(run) if run.exists() else ()) or process.poll() is not None)
    workers = children(process.pid)
    assert len(workers) >= 2
    process.send_signal(signal.SIGTERM)
    told = process.communicate(timeout=120)[1]
    wait_for(lambda: not any(lives(pid) for pid in workers))
    assert process.returncode == 143
    assert "stopped by SIGTERM" in told
    assert "Traceback" not in told
    assert not [name for name in files(run) if Path(name).name.startswith(".")]
    found = kros("run", fast, "--out", run, "--until", "synthesize")
    assert found.exit_code == 0
    assert "unchanged" in found.stderr
    later = ("evaluation/", "left_out/", "report", "metrics", "study")
    whole = {k: v for k, v in results(finished).items() if not k.startswith(later)}
    assert {k: v for k, v in results(run).items() if not k.startswith(("metrics", "study"))} == whole


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_a_run_killed_in_the_middle_of_a_stage_leaves_no_workers_and_only_its_draft(kros, fast, finished, tmp_path):
    run = tmp_path / "run"
    process = start(fast, run, "--workers", "2", "--until", "quantify")
    wait_for(lambda: list(run.glob("store/.kros.*/draft/uncertainty")) or process.poll() is not None)
    workers = children(process.pid)
    process.kill()
    process.communicate()
    wait_for(lambda: not any(lives(pid) for pid in workers))
    assert not (run / "uncertainty").exists()
    assert kros("report", run).exit_code == 2  # nothing was finished that could be shown
    assert kros("run", fast, "--out", run, "--until", "quantify").exit_code == 0
    assert not [name for name in files(run) if Path(name).name.startswith(".") or name.startswith(".")]
    assert results(run)["uncertainty/choice.json"] == results(finished)["uncertainty/choice.json"]
