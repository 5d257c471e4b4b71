"""The edge of the command line: whatever goes wrong, one message and an exit code of 1 or 2, never a traceback."""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kros.data import Channel, Role, from_arrays, write_parquet

CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("torque", Role.INPUT),
)


def motion(seed: int, n: int = 400) -> np.ndarray:
    """A damped oscillator on noise, shape (n, 3), 0.01 s apart."""
    rng = np.random.default_rng(seed)
    u, x = np.repeat(rng.normal(size=n // 10), 10), np.zeros((n, 2))
    for k in range(n - 1):
        x[k + 1] = [[1.0, 0.01], [-0.05, 0.95]] @ x[k] + [0.0, 0.1 * u[k]]
    return np.column_stack([x + 1e-4 * rng.normal(size=(n, 2)), u])


def episodes() -> dict:
    return {unit: [motion(10 * i + k) for k in range(3)] for i, unit in enumerate("abc")}


@pytest.fixture
def store(tmp_path):
    """Write recordings and a study on them."""

    def write(data=None, period=0.01, extra="") -> Path:
        write_parquet(from_arrays(data or episodes(), CHANNELS, period), tmp_path / "recordings")
        (tmp_path / "study.toml").write_text(f'[data]\nsource = "recordings"\nreader = "parquet"\n{extra}\n')
        return tmp_path / "study.toml"

    return write


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
def test_folders_that_cannot_be_made(kros, store, tmp_path, out):
    study = store()
    (tmp_path / "file").write_text("")
    (tmp_path / "locked").mkdir()
    if out.startswith("locked"):
        if os.geteuid() == 0:
            pytest.skip("nothing is forbidden to root")
        (tmp_path / "locked").chmod(0o500)
    result = kros("run", study, "--out", tmp_path / out, "--until", "read")
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


@pytest.mark.parametrize(
    ("content", "word"),
    [("a = " + "[" * 5000, "nested"), ('[data]\nsource = "a\\u0000b"\n', "NUL"), ("data = 5\n", "data")],
    ids=range(3),
)
def test_studies_that_cannot_be_used(kros, store, tmp_path, content, word):
    study = store()
    study.write_text(content)
    said(kros("run", study, "--out", tmp_path / "out"), 2, word)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", ["[" * 5000, "9" * 5000])
def test_values_on_the_command_line(kros, store, tmp_path, value):
    result = kros("run", store(), "--out", tmp_path / "out", "--set", f"identify.alpha={value}")
    said(result, 2, "--set")


@pytest.mark.parametrize("period", [1e-7, 1.0, 3600.0])
def test_no_sampling_period_is_doubted(kros, store, tmp_path, period):
    out = tmp_path / "out"
    result = kros("run", store(period=period), "--out", out, "--until", "read")
    assert result.exit_code == 0, result.output
    assert json.loads((out / "metrics.json").read_text())["study"].get("alerts", []) == []


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
