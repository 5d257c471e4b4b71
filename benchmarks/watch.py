"""`kros watch` under kills: many recordings arrive, some slowly, some damaged, while the watch is killed at random times.

python benchmarks/watch.py FOLDER [--files 10000] [--kills 50]: makes a study of simulated machines in FOLDER, lets
recordings arrive, kills the watch with SIGKILL, and counts results and lines: every recording has one result, and none
has two lines, since none is judged twice.
"""

from __future__ import annotations

import argparse
import collections
import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

STUDY = """
[data]
source = "batch"
reader = "csv"
[data.csv]
files = '(?P<unit>[a-z0-9]+)_(?P<episode>[0-9]+)[.]csv'
time = "t"
channel = [
  { name = "position", role = "state", measured = true, unit = "rad", column = "position" },
  { name = "velocity", role = "state", unit = "rad/s", column = "velocity" },
  { name = "torque", role = "input", column = "torque" },
]
[identify]
refine = false
[uncertainty]
form = "additive"
n_freqs = 60
"""
PERIOD_S, SAMPLES, UNITS = 0.01, 200, 12


def recording(seed: int) -> str:
    """Return a recording of a machine as text: a mass on a spring, driven by noise."""
    rng = np.random.default_rng(seed)
    stiffness, friction, gain = np.array([60.0, 3.0, 40.0]) * np.exp(0.05 * rng.normal(size=3))
    u, x = np.repeat(rng.normal(size=SAMPLES // 10), 10), np.zeros((SAMPLES, 2))
    for k in range(SAMPLES - 1):
        velocity = x[k, 1] + PERIOD_S * (gain * u[k] - stiffness * x[k, 0] - friction * x[k, 1]) + 0.05 * rng.normal()
        x[k + 1] = x[k, 0] + PERIOD_S * velocity, velocity
    rows = np.column_stack([PERIOD_S * np.arange(SAMPLES), x + rng.normal(size=x.shape) * (1e-4, 1e-2), u])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    return "\n".join(["t,position,velocity,torque", *lines, ""])


def make_study(folder: Path) -> Path:
    """Run a study of a few machines; return the run."""
    (folder / "batch").mkdir(parents=True)
    for k in range(UNITS):
        for episode in range(3):
            (folder / "batch" / f"b{k:02d}_{episode}.csv").write_text(recording(1000 * k + episode))
    (folder / "study.toml").write_text(STUDY)
    command = ["run", folder / "study.toml", "--out", folder / "run", "--until", "quantify", "--workers", "1"]
    subprocess.run([sys.executable, "-m", "kros", *map(str, command)], check=True, capture_output=True)
    return folder / "run"


def arrive(folder: Path, files: int, pause_s: float) -> None:
    """Write recordings one after the other: every 50th slowly, every 70th damaged."""
    for k in range(files):
        text, path = recording(10**6 + k), folder / f"n{k:05d}_0.csv"
        if k % 70 == 69:
            text = text[: len(text) // 3]
        pieces = 20 if k % 50 == 49 else 1
        with path.open("w") as file:
            for start in range(pieces):
                file.write(text[start * len(text) // pieces : (start + 1) * len(text) // pieces])
                file.flush()
                time.sleep(pause_s)


def campaign(folder: Path, files: int, kills: int, every_s: float = 0.1, pause_s: float = 0.02, seed: int = 0) -> dict:
    """Let recordings arrive, kill the watch at random times, let the last one end; return counts."""
    run, new, rng = make_study(folder), folder / "new", np.random.default_rng(seed)
    new.mkdir()
    writer = threading.Thread(target=arrive, args=(new, files, pause_s))
    writer.start()
    command = [sys.executable, "-m", "kros", "watch", str(new), str(run), "--every", str(every_s)]
    began, lines, used = time.monotonic(), collections.Counter[str](), 0
    while True:
        once = used == kills and not writer.is_alive()
        with (folder / "lines").open("w+") as log:
            watch = subprocess.Popen([*command, *(["--once"] if once else [])], stdout=log, stderr=subprocess.DEVNULL)
            if once:
                assert watch.wait() == 0
            else:
                mean = 0.06 * files / (kills + 1) + 2.0
                time.sleep(rng.uniform(0.5, 2 * mean - 0.5))
                watch.send_signal(signal.SIGKILL)
                watch.wait()
                used = min(kills, used + 1)
            log.seek(0)
            lines.update(line[11:].split(":")[0] for line in log.read().splitlines())
        if once:
            break
    results = collections.Counter(json.loads(p.read_text())["recording"] for p in folder.glob("new-results/**/*.json"))
    verdicts = collections.Counter(json.loads(p.read_text())["verdict"] for p in folder.glob("new-results/**/*.json"))
    return {
        "files": files,
        "kills": used,
        "recordings with one result": sum(count == 1 for count in results.values()),
        "with more": sum(count > 1 for count in results.values()),
        "judged twice": sum(count > 1 for count in lines.values()),
        "lines that a kill took": files - len(lines),
        "verdicts": dict(verdicts),
        "seconds": round(time.monotonic() - began),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=50)
    given = parser.parse_args()
    print(json.dumps(campaign(given.folder, given.files, given.kills), indent=1))
