"""What people type and read: version, help, names that are nearly right, progress where there is no terminal, Ctrl-C, a list of a run."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import warnings

import pytest

import kros as package
from kros.cli import OnceHandler
from kros.study.engine.executors import Lines


def test_version_and_module():
    said = subprocess.run([sys.executable, "-m", "kros", "--version"], capture_output=True, text=True, check=True)
    assert said.stdout == f"kros {package.__version__}\n"


def test_a_line_is_written_while_a_stage_takes_long(capsys):
    lines = Lines(every_s=0.0)
    lines.start("synthesize", 4)
    lines.advance()
    lines.finish("synthesize", 1.25, skipped=False)
    assert capsys.readouterr().err == "  synthesize ... 1 of 4, 0 s\nsynthesize      1.2 s\n"


def test_warnings_are_said_once_in_one_line(capsys):
    handler = OnceHandler()
    logger = logging.Logger("kros.somewhere")
    logger.addHandler(handler)
    for _ in range(3):
        logger.warning("unit %s\nis odd", "a")
    logger.warning("unit b is odd")
    shown = warnings.formatwarning("a bound is loose", UserWarning, "/x/y.py", 7, "line of code")
    handler.handle(logging.LogRecord("py.warnings", logging.WARNING, "", 0, "%s", (shown,), None))
    assert capsys.readouterr().err.splitlines() == [
        "warning: unit a is odd",
        "warning: unit b is odd",
        "warning: a bound is loose",
    ]


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_ctrl_c_says_how_to_go_on(tmp_path):
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # who started the tests may have had it ignored
    wait = "import kros.study.commands.demo as d, time; d.run_demo = lambda *a, **k: (print('runs', flush=True), time.sleep(60))"
    code = f"{heard}; {wait}; from kros.cli import app; app()"
    command = [sys.executable, "-c", code, "demo", "--out", str(tmp_path / "demo")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "runs\n"
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said.strip() == "kros: stopped by Ctrl-C; the same command goes on where this one ended."


def test_a_run_that_has_not_ended_is_listed(kros, study, tmp_path):
    assert kros("run", study(), "--out", tmp_path / "run", "--until", "read").exit_code == 0
    assert "stages done: read" in kros("list", tmp_path / "run").output
    (tmp_path / "run" / "metrics.json").unlink()  # as where it was stopped
    found = kros("list", tmp_path / "run")
    assert found.exit_code == 0, found.output
    assert "stages done: read" in found.output
    assert "the same command of kros run goes on with it" in found.output
    assert kros("list", tmp_path).exit_code == 2
