"""Three small studies whose numbers should not move when code only moves: drives, pendulums, and DC motors as CSV files with a mapping.

    python benchmarks/pinned.py --save pinned                 (before a change: minutes)
    python benchmarks/pinned.py --against pinned              (after it)

Recordings are simulated when they are saved and read again, byte for byte, when they are compared, so that only the study itself is compared. Every number of
`metrics.json` and of the observer that is deployed is compared; what differs by more than `--rtol`, is missing or is new is printed,
the largest differences first, and the exit code is 1. Only the command line is used, so that modules may move.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

KROS = [sys.executable, "-c", "from kros.cli import app; app()"]
STUDIES = {
    "drives": ("harmonic-drive", '[data]\nsource = "drives"\nreader = "parquet"\n'),
    "pendulums": (
        "pendulum",
        '[data]\nsource = "pendulums"\nreader = "parquet"\n[lifting]\nfunctions = ["sin(position)"]\n',
    ),
    "motors": (
        "dc-motor",
        '[data]\nsource = "motors-csv"\nreader = "csv"\n[lifting]\nfunctions = ["tanh(velocity)"]\n',
    ),
}
MAPPING = """[data.csv]
files = '(?P<unit>[^/]+)/(?P<episode>[^/]+)\\.csv'
time = "time"
[[data.csv.channel]]
name = "position"
column = "position"
role = "state"
measured = true
unit = "rad"
[[data.csv.channel]]
name = "velocity"
column = "velocity"
role = "state"
unit = "rad/s"
[[data.csv.channel]]
name = "current"
column = "current"
role = "state"
unit = "A"
[[data.csv.channel]]
name = "voltage"
column = "voltage"
role = "input"
unit = "V"
"""
MOVES = ("timing_s", "solve_s")  # keys that differ from run to run
SMALLEST = 1e-12  # differences below this share of a list's largest number are rounding


def main() -> None:
    """Save the results of the three studies, or compare with saved ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--save", type=Path)
    what.add_argument("--against", type=Path)
    parser.add_argument("--rtol", type=float, default=1e-9)
    parser.add_argument(
        "--only", choices=list(STUDIES), nargs="+", default=list(STUDIES), help="compare with these alone"
    )
    options = parser.parse_args()
    folder = options.save or options.against
    if options.save:
        record(folder)
    with tempfile.TemporaryDirectory() as scratch:
        results = {name: study(folder, Path(scratch) / name, name) for name in options.only}
    if options.save:
        (folder / "results.json").write_text(json.dumps(results, indent=1))
        return
    before = {
        name: found for name, found in json.loads((folder / "results.json").read_text()).items() if name in options.only
    }
    changes = sorted(differences(before, results, options.rtol), key=lambda c: -c[0])
    for size, text in changes[:60]:
        print(f"{size:.2g}  {text}")
    print(f"{len(changes)} differences")
    sys.exit(bool(changes))


def record(folder: Path) -> None:
    """Simulate the recordings and write the studies."""
    folder.mkdir(parents=True)
    for name, (plant, text) in STUDIES.items():
        run(
            "simulate",
            folder / name,
            "--plant",
            plant,
            "--units",
            "5",
            "--episodes",
            "5",
            "--seconds",
            "6",
            "--seed",
            "11",
            "--outlier",
        )
        (folder / f"{name}.toml").write_text(text + (MAPPING if name == "motors" else ""))
    write_csv(folder / "motors", folder / "motors-csv")


def write_csv(source: Path, target: Path) -> None:
    """Write Parquet recordings as CSV, a folder for each unit."""
    import numpy as np

    from kros.data.readers.parquet import read_parquet

    population = read_parquet(source)
    header = ",".join(["time", *(c.name for c in population.channels)])
    keys = population.keys()
    for key in keys:
        samples = population.read(key)
        time = np.arange(len(samples)) * population.sample_period_s
        path = target / key.unit / f"{key.episode}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, np.column_stack([time, samples]), delimiter=",", header=header, comments="", fmt="%.17g")


def study(folder: Path, out: Path, name: str) -> dict[str, Any]:
    """Run one study and return what it says."""
    run("run", folder / f"{name}.toml", "--out", out, "--workers", "2")
    found = {"metrics": json.loads((out / "metrics.json").read_text())}
    deployed = out / "observers" / "deployed.json"
    return found | ({"deployed": json.loads(deployed.read_text())} if deployed.exists() else {})


def run(*arguments: str | Path) -> None:
    """Run a command of kros."""
    subprocess.run([*KROS, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def differences(before: Any, after: Any, rtol: float, place: str = "") -> Iterator[tuple[float, str]]:
    """Walk two JSON values side by side and tell where they differ, with the size of the difference."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted(before.keys() | after.keys()):
            if key in MOVES:
                continue
            if key not in before or key not in after:
                yield math.inf, f"{place}.{key}: {'new' if key in after else 'missing'}"
            else:
                yield from differences(before[key], after[key], rtol, f"{place}.{key}")
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        scale = max((abs(v) for v in before if isinstance(v, float)), default=0.0)
        for i, (old, new) in enumerate(zip(before, after, strict=True)):
            if not (isinstance(old, float) and isinstance(new, float) and abs(old - new) <= SMALLEST * scale):
                yield from differences(old, new, rtol, f"{place}[{i}]")
    elif isinstance(before, int | float) and isinstance(after, int | float):
        if not math.isclose(before, after, rel_tol=rtol, abs_tol=0.0):
            yield abs(after - before) / max(abs(before), 1e-300), f"{place}: {before!r} -> {after!r}"
    elif before != after:
        yield math.inf, f"{place}: {before!r} -> {after!r}"


if __name__ == "__main__":
    main()
