"""`kros watch`: each recording is judged once, whatever kills it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import watch
from watch import campaign, make_study, recording


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return make_study(tmp_path_factory.mktemp("watched"))


def results(out: Path) -> dict[str, list[dict]]:
    found: dict[str, list[dict]] = {}
    for path in out.rglob("*.json"):
        content = json.loads(path.read_text())
        found.setdefault(content["recording"], []).append(content)
    return found


def test_recordings_under_kills_are_judged_once(run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(watch, "make_study", lambda _: run)
    counts = campaign(tmp_path, 10, 2, pause_s=0.01)
    assert (counts["recordings with one result"], counts["with more"], counts["judged twice"]) == (10, 0, 0)
    assert sum(counts["verdicts"].values()) == 10


def test_damaged_files_are_refused_and_the_watch_goes_on(kros, run, tmp_path, caplog) -> None:
    new = tmp_path / "new"
    (new / "deeper").mkdir(parents=True)
    (new / "a_0.csv").write_text("nothing")
    (new / "b_0.csv").write_bytes(bytes(range(256)))
    (new / "deeper" / "n01_0.csv").write_text(recording(7))
    (new / ".hidden").write_text("is left alone")
    result = kros("watch", new, run, "--every", 0.05, "--once")
    assert result.exit_code == 0, result.output
    lines = [line.split()[:2] for line in result.stdout.splitlines()]
    assert lines[:2] == [["refused", "a_0.csv:"], ["refused", "b_0.csv:"]]
    assert [name for _, name in lines[2:]] == ["deeper/n01_0.csv:"]
    found = results(tmp_path / "new-results")
    assert set(found) == {"a_0.csv", "b_0.csv", "deeper/n01_0.csv"}
    assert str(new) in found["a_0.csv"][0]["reason"]
    assert found["deeper/n01_0.csv"][0]["rows"][0]["unit"] == "n01"
    assert kros("watch", new, run, "--every", 0.05, "--once").stdout == ""
    (new / "a_0.csv").write_text(recording(8))
    assert kros("watch", new, run, "--every", 0.05, "--once").stdout.split()[1] == "a_0.csv:"
    assert len(results(tmp_path / "new-results")["a_0.csv"]) == 2  # another file of that name
    (new / "notes.csv").write_text("of another kind")
    result = kros("watch", new, run, "--every", 0.05, "--once")
    assert result.stdout.startswith(f"refused    notes.csv: Reading {new} as csv: no file matches")
    assert ".kros" not in result.output + caplog.text  # where it is read
    assert kros("watch", tmp_path / "none", run).exit_code == 2
    assert kros("watch", new, tmp_path).exit_code == 2


def test_the_files_of_a_unit_are_judged_together(kros, run, tmp_path) -> None:
    new = tmp_path / "new"
    new.mkdir()
    for episode in range(3):
        (new / f"n01_{episode}.csv").write_text(recording(episode))
    (new / "n02_0.csv").write_text(recording(7))
    (new / "n01_3.csv").write_text(recording(1))
    kros("watch", new, run, "--every", 0.05, "--once")
    found = {name: of for name, (of,) in results(tmp_path / "new-results").items()}
    episodes = {name: [row["episodes"] for row in of["rows"]] for name, of in found.items()}
    assert episodes == {"n01_0.csv": [1], "n01_1.csv": [2], "n01_2.csv": [3], "n01_3.csv": [], "n02_0.csv": [1]}
    assert found["n01_3.csv"]["verdict"] == "refused"
    assert "is a copy of episode 1 of unit n01" in found["n01_3.csv"]["reason"]


def test_a_name_in_another_encoding_is_refused(run, tmp_path) -> None:
    new = tmp_path / "new"
    new.mkdir()
    with open(os.fsencode(new / "c") + b"\xff_0.csv", "w") as file:
        file.write(recording(9))
    command = [sys.executable, "-m", "kros", "watch", new, run, "--once"]  # a log with such a name breaks pytest-xdist
    done = subprocess.run(command, check=True, capture_output=True)
    assert done.stdout.split()[:2] == [b"refused", rb"c\udcff_0.csv:"]


def test_a_growing_file_is_waited_for_and_sigterm_ends_cleanly(run, tmp_path) -> None:
    new, text = tmp_path / "new", recording(9)
    new.mkdir()
    command = [sys.executable, "-m", "kros", "watch", str(new), str(run), "--every", "0.3"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watch:
        with (new / "n01_0.csv").open("w") as file:
            for k in range(30):
                file.write(text[k * len(text) // 30 : (k + 1) * len(text) // 30])
                file.flush()
                assert not list((tmp_path / "new-results").rglob("*.json"))
                time.sleep(0.05)
        assert "n01_0.csv" in watch.stdout.readline()
        second = subprocess.run(command, capture_output=True, text=True)
        assert second.returncode == 2  # another one is at work there
        watch.send_signal(signal.SIGTERM)
        assert watch.wait() == 143
        assert "Traceback" not in watch.stderr.read()
    assert [
        name for name in os.listdir(tmp_path / "new-results") if name.startswith(".kros.") and "lock" not in name
    ] == []
