"""Kill -9 runs at random moments and just after random files appeared, resume them, and compare with a run that nobody killed.

    python benchmarks/reliability/kill_points.py --count 100 --demo-count 5

Runs are those of the command line with two worker processes. Up to four kills follow one another in one run folder before it is let finish; then
its files are compared one by one. Moments are drawn over the measured time of the run that nobody killed, so a slow machine changes nothing.
"""

from __future__ import annotations

import argparse
import glob
import json
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from campaign import Tally, main

KROS = (sys.executable, "-c", "from kros.cli import app; app()")
STUDY = """
name = "four drives"
[data]
source = "recordings"
reader = "parquet"
[identify]
refine = false
[uncertainty]
n_freqs = 60
[synthesis]
methods = ["residual_h2"]
[observer]
baselines = ["open_loop", "kalman_tuned"]
"""
TIMES = {"seconds", "solve_s", "timing_s", "checksum"}  # a checksum is of the times too
STAGES = ("simulate", "read", "calibrate", "identify", "quantify", "synthesize", "evaluate", "report")
IN_A_ROW, PATIENCE = (
    4,
    10,
)  # kills before a run is let finish; times that a run nobody killed takes, after which one hangs
_TIMED_CELL = re.compile(r'<td data-label="(?:seconds|solved in \(s\))"[^>]*>[^<]*</td>')


@dataclass
class Campaign:
    """One command, the run folder it writes, and what it leaves when nobody kills it."""

    command: tuple[str, ...]
    folder: Path
    draw: random.Random
    expected: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    files: list[str] = field(default_factory=list)

    def measure(self) -> None:
        """Run once without a kill."""
        began = time.perf_counter()
        subprocess.run(self.command, check=True, capture_output=True)
        self.seconds = time.perf_counter() - began
        self.expected = results(self.folder)
        self.files = sorted(name for name in self.expected if not name.startswith("store/"))

    def kills(self, count: int, tally: Tally) -> None:
        """Kill so many times, in rows of some kills each."""
        while tally.tried < count:
            shutil.rmtree(self.folder, ignore_errors=True)
            killed, alive = [], 0
            for _ in range(min(IN_A_ROW, count - tally.tried)):
                found = self.kill()
                if found is None:
                    break
                killed.append(found[0])
                alive += found[1]
            wrong = self.finish()
            for stage in killed:
                problem = wrong or ("a worker lived on" if alive else "")
                tally.add(problem or f"killed in {stage}, resumed to the same bytes", failed=bool(problem))

    def kill(self) -> tuple[str, int] | None:
        """Start, kill at some moment; return the stage that was running and how many workers lived on, or None where the run was faster."""
        process = subprocess.Popen(self.command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        reached = self.moment()
        while process.poll() is None and not reached():
            time.sleep(0.0002)
        workers = descendants(process.pid)
        process.kill()
        if process.wait() == 0:
            return None
        deadline = time.monotonic() + 30
        while any(map(lives, workers)) and time.monotonic() < deadline:
            time.sleep(0.05)
        done = manifest(self.folder)
        following = [stage for stage in STAGES if stage not in done and (stage != "simulate" or "demo" in self.command)]
        return (following[0] if following else "the end"), sum(map(lives, workers))

    def moment(self) -> Callable[[], bool]:
        """Return what tells that the moment to kill has come: some time, or that a file is there, drafted or in place."""
        if self.draw.random() < 0.5:
            end = time.perf_counter() + self.draw.uniform(0, self.seconds - self.done())
            return lambda: time.perf_counter() > end
        missing = [name for name in self.files if not (self.folder / name).exists()] or self.files
        name = self.draw.choice(missing)
        pattern = glob.escape(name) if self.draw.random() < 0.5 else f"store/.kros.*/draft/{glob.escape(name)}"
        end = time.perf_counter() + PATIENCE * self.seconds
        return lambda: (self.folder / name).exists() or any(self.folder.glob(pattern)) or time.perf_counter() > end

    def done(self) -> float:
        """Return the seconds that finished stages took, at most nine tenths of all."""
        taken = sum(float(about["seconds"]) for about in manifest(self.folder).values())
        return min(taken, 0.9 * self.seconds)

    def finish(self) -> str:
        """Let the run finish; return what is wrong with it, if anything."""
        try:
            ended = subprocess.run(
                self.command, capture_output=True, text=True, timeout=PATIENCE * self.seconds, check=False
            )
        except subprocess.TimeoutExpired:
            return "hang"
        if "Traceback" in ended.stderr:
            return "traceback"
        if ended.returncode:
            return f"exit code {ended.returncode}"
        found = results(self.folder)
        if left := sorted(name for name in found if any(part.startswith(".") for part in Path(name).parts)):
            return f"left behind: {left[0]}"
        if found.keys() != self.expected.keys():
            return f"other files: {sorted(found.keys() ^ self.expected.keys())[:3]}"
        changed = [name for name, content in found.items() if content != self.expected[name]]
        return f"silent change: {changed[:3]}" if changed else ""


def manifest(folder: Path) -> dict[str, Any]:
    """Return what a run's manifest says of its stages."""
    path = folder / "manifest.json"
    found = json.loads(path.read_text())["artefacts"] if path.exists() else {}
    return {stage: found[stage] for stage in STAGES if stage in found}


def results(folder: Path) -> dict[str, Any]:
    """Return all files of a run with what does not depend on the time that something took; of manifests the names that they list."""
    return {
        name: content(folder / name, name)
        for name in sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    }


def content(path: Path, name: str) -> Any:
    """Return a file without times."""
    if path.name == "artefact.json":
        return sorted(json.loads(path.read_text())["files"])
    if path.name == "manifest.json":
        return {stage: sorted(about["files"]) for stage, about in manifest(path.parent).items()}
    if path.suffix == ".json":
        return timeless(json.loads(path.read_text()))
    if path.suffix == ".html":
        return _TIMED_CELL.sub("", path.read_text())
    return path.read_bytes()


def timeless(found: Any) -> Any:
    """Return a JSON value without times."""
    if isinstance(found, dict):
        return {key: timeless(value) for key, value in found.items() if key not in TIMES}
    return [timeless(value) for value in found] if isinstance(found, list) else found


def descendants(pid: int) -> list[int]:
    """Return the processes that a process started, and theirs."""
    try:
        own = [
            int(child)
            for task in Path(f"/proc/{pid}/task").iterdir()
            for child in (task / "children").read_text().split()
        ]
    except FileNotFoundError:
        return []
    return own + [further for child in own for further in descendants(child)]


def lives(pid: int) -> bool:
    """Tell whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def campaigns(folder: Path, seed: int) -> Iterator[tuple[str, Campaign]]:
    """Yield the four-drive study and the demo."""
    recordings = (
        "simulate",
        str(folder / "recordings"),
        "--units",
        "4",
        "--episodes",
        "2",
        "--seconds",
        "5",
        "--seed",
        str(seed),
    )
    subprocess.run((*KROS, *recordings), check=True, capture_output=True)
    (folder / "study.toml").write_text(STUDY)
    run = ("run", str(folder / "study.toml"), "--out", str(folder / "run"), "--workers", "2")
    yield (
        "a study of four drives, killed (kill -9) and resumed",
        Campaign((*KROS, *run), folder / "run", random.Random(seed)),
    )
    demo = ("demo", "--out", str(folder / "demo"), "--seed", str(seed), "--workers", "2")
    yield "the demo, killed (kill -9) and resumed", Campaign((*KROS, *demo), folder / "demo", random.Random(seed))


def run(count: int, seed: int, demo_count: int) -> list[Tally]:
    """Kill and resume both."""
    tallies = []
    with tempfile.TemporaryDirectory() as scratch:
        for (cases, campaign), wanted in zip(campaigns(Path(scratch), seed), (count, demo_count), strict=True):
            tally = Tally(cases, "the files of a run that nobody killed, and the processes that it started")
            if wanted:
                campaign.measure()
                campaign.kills(wanted, tally)
                tally.note = (
                    f"Without a kill it takes {campaign.seconds:.1f} s; {len(campaign.expected)} files are compared."
                )
                tallies.append(tally)
    return tallies


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--demo-count", type=int, default=5)
    options, sys.argv[1:] = parser.parse_known_args()
    main(
        "kill_points", "Runs that are killed and resumed", lambda count, seed: run(count, seed, options.demo_count), 100
    )
