"""The edge of the command line: whatever goes wrong, one message and an exit code of 1 or 2, never a traceback."""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


def said(result, code, *words):
    assert result.exit_code == code, result.output
    messages = [line for line in result.stderr.splitlines() if line.startswith("kros: ")]
    assert len(messages) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in messages[0]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "x"), ("No space left", "'x'")),
        (PermissionError(errno.EACCES, "Permission denied", "x"), ("Permission denied",)),
        (NotADirectoryError(errno.ENOTDIR, "Not a directory", "x", None, "y"), ("'x' -> 'y'",)),
        (MemoryError(), ("Memory", "--workers")),
        (KeyError("alpha"), ("Internal error", "KeyError", "--debug")),
        (StopIteration(), ("Internal error",)),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates not allowed"), ("Internal error",)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_any_exception_becomes_one_message(kros, tmp_path, monkeypatch, error, words):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("kros.study.load_config", fail)
    code = 2 if isinstance(error, PermissionError | NotADirectoryError) else 1  # a place that somebody named
    said(kros("run", tmp_path), code, *words)
    assert kros("--debug", "run", tmp_path).exception is error


@pytest.mark.parametrize(
    ("command", "arguments", "place"),
    [
        ("report", 1, "stages.report.render_run"),
        ("check", 2, "commands.check.check_units"),
        ("estimate", 3, "commands.estimate.estimate_recordings"),
        ("figures", 2, "stages.report.write_figures"),
        ("simulate", 1, "commands.demo.simulate_to"),
        ("demo", 0, "commands.demo.run_demo"),
        ("doctor", 0, "commands.summary.diagnose"),
        ("init", 1, "commands.init.init_study"),
        ("list", 1, "commands.summary.list_run"),
    ],
)
def test_an_exception_of_any_command_becomes_one_message(kros, tmp_path, monkeypatch, command, arguments, place):
    def fail(*_, **__):
        raise KeyError("alpha")

    monkeypatch.setattr(f"kros.study.{place}", fail)
    said(kros(command, *[tmp_path / f"{i}" for i in range(arguments)]), 1, "Internal error", "KeyError", "--debug")


@pytest.mark.parametrize("out", ["x" * 300, "file/inside", "locked/inside"])
def test_folders_that_cannot_be_made(kros, study, tmp_path, out):
    (tmp_path / "file").write_text("")
    (tmp_path / "locked").mkdir()
    if out.startswith("locked"):
        if os.geteuid() == 0:
            pytest.skip("nothing is forbidden to root")
        (tmp_path / "locked").chmod(0o500)
    result = kros("run", study(), "--out", tmp_path / out, "--until", "read")
    assert result.exit_code in (1, 2)
    said(result, result.exit_code)


def shell(*arguments: str, **options) -> subprocess.CompletedProcess:
    code = "from kros.cli import app; app()"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], stderr=subprocess.PIPE, text=True, check=False, **options
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_an_output_that_is_full_or_gone():
    with open("/dev/full", "w") as full:
        done = shell("doctor", stdout=full)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "No space left" in done.stderr
    reader, writer = os.pipe()
    os.close(reader)
    done = shell("doctor", stdout=writer)
    os.close(writer)
    assert done.returncode == 1
    assert done.stderr == ""


def test_runs_of_another_version_and_damaged_ones(kros, demo, recorded, tmp_path):
    """Every JSON file of a run, emptied of its keys or of its sense: each command says so, or does not need it."""
    run = tmp_path / "run"
    shutil.copytree(demo, run)
    study = json.loads((run / "study.json").read_text())
    for content in ({**study, "identification": {}}, {"name": "x"}, [], {**study, "data": 5}):
        (run / "study.json").write_text(json.dumps(content))
        for command in (("check", run, recorded), ("estimate", run, recorded, tmp_path / "e.parquet")):
            said(kros(*command), 2, "study.json", "version")
    (run / "study.json").write_text(json.dumps(study))


@pytest.mark.parametrize("content", [b"{}", b'{"schema": 1, "kind": 5}', b"[", b"5"])
def test_files_of_a_run_without_their_content(kros, demo, recorded, tmp_path, content):
    run, out = tmp_path / "run", tmp_path / "e.parquet"
    shutil.copytree(demo, run)
    for name in ("population/facts.json", "calibration/calibration.json", "observers/deployed.json"):
        good = (run / name).read_bytes()
        (run / name).write_bytes(content)
        said(kros("estimate", run, recorded, out), 2, Path(name).name)
        (run / name).write_bytes(good)
    for name in ("metrics.json", "observers/observers.json"):
        good = (run / name).read_bytes()
        (run / name).write_bytes(content)
        result = kros("report", run)
        assert result.exit_code in (1, 2), (name, result.output)
        said(result, result.exit_code)
        assert "Internal error" not in result.stderr
        (run / name).write_bytes(good)
