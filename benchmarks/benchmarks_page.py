"""Writes docs/benchmarks.md from what pytest-benchmark measured.

make bench        or        python benchmarks/benchmarks_page.py build/benchmarks.json
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"
PACKAGES = ("kros", "numpy", "scipy", "clarabel", "cvxpy", "pandas", "pykoop", "control", "slycot", "dkpy")
HEAD = """# Benchmarks

*How fast is each computation of kros beside other packages, and how does its time grow?*

```console
$ make bench
```

Each computation is compared with other packages and with the published algorithm in plain NumPy (`benchmarks/plain.py`,
`benchmarks/paper_slsqp.py`), on the same problem in the same run. `benchmarks/benchmarks_page.py` generates this page.

{facts}

Times are medians of the processor time of one process on one core, without imports. The results are compared before a
time counts: *differs by* is the largest relative difference. If another implementation is too slow for the whole problem,
it solves the named share, and its time is divided by this share. The ratio is its time over that of kros: **above one,
kros is faster; below one, the other is**.

## Stages

"""
GROWTH = """
## Growth

The exponent is the slope of a straight line through the logarithms of sizes and times; one means proportional.
`benchmarks/bench_growth.py` defines the problems.
"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(render(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")), versions()), encoding="utf-8")


def versions() -> dict[str, str]:
    """Return the versions of what is compared, as installed."""

    def found(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "not installed, left out"

    return {package: found(package) for package in PACKAGES}


def render(measured: dict[str, Any], packages: dict[str, str]) -> str:
    """Return the page's text."""
    machine, commit = measured["machine_info"], measured.get("commit_info", {})
    facts = {
        "date": measured["datetime"][:10],
        "processor": f"{machine['cpu'].get('brand_raw', machine['machine'])}, {machine['cpu'].get('count', '?')} cores",
        "system": f"{machine['system']} {machine['machine']}, {machine['python_implementation']} {machine['python_version']}",
        "versions": ", ".join(f"{name} {number}" for name, number in packages.items()),
        "commit": f"{commit.get('id', 'unknown')[:10]}{' with changes' if commit.get('dirty') else ''}",
        "command": "`make bench`",
    }
    table = "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in facts.items())
    rows = [{**b["extra_info"], "median_s": b["stats"]["median"]} for b in measured["benchmarks"]]
    stages = [row | {"stage": b["group"]} for row, b in zip(rows, measured["benchmarks"], strict=True) if "by" in row]
    return (
        HEAD.format(facts=table)
        + _stages(stages)
        + GROWTH
        + _growth([row for row in rows if "curve" in row])
        + _steps(rows)
    )


def _stages(rows: list[dict[str, Any]]) -> str:
    lines = ["| stage | problem | by | time | ratio | differs by | |", "|---|---|---|---|---|---|---|"]
    for stage, found in groupby(rows, lambda row: row["stage"]):
        contestants = list(found)
        own = next((row["median_s"] for row in contestants if row["by"] == "kros"), np.nan)
        for row in contestants:
            seconds = row["median_s"] / row["share"]
            first = (f"**{stage}**", row["size"]) if row is contestants[0] else ("", "")
            ratio = "" if row["by"] == "kros" else f"{seconds / own:.{0 if seconds > 10 * own else 2}f}"
            differs = (
                ""
                if row["by"] == "kros"
                else "not compared"
                if np.isnan(row["deviation"])
                else f"{row['deviation']:.0e}"
            )
            share = f"given {row['share']:.2g} of the problem" if row["share"] < 1 else ""
            lines.append(f"| {' | '.join([*first, row['by'], _time(seconds), ratio, differs, row['note'] or share])} |")
    return "\n".join(lines) + "\n"


def _growth(rows: list[dict[str, Any]]) -> str:
    text = ""
    for against, group in groupby(rows, lambda row: row["against"]):
        text += f"\n### Against {against}\n\n| stage | times | exponent |\n|---|---|---|\n"
        for curve, found in groupby(group, lambda row: row["curve"]):
            points = [(row["size"], row["median_s"]) for row in found]
            slope = np.polyfit(*np.log(np.array(points)).T, 1)[0]
            text += (
                f"| {curve} | {', '.join(f'{size}: {_time(seconds)}' for size, seconds in points)} | {slope:.2f} |\n"
            )
    return text


def _steps(rows: list[dict[str, Any]]) -> str:
    found = [f"| {row['observer']} | {row['us_a_step']:.1f} µs |\n" for row in rows if "us_a_step" in row]
    head = "\n## One step of a running observer\n\nIn Python, named estimate included (`benchmarks/bench_running.py`).\n\n| observer | a step |\n|---|---|\n"
    return head + "".join(found) if found else ""


def _time(seconds: float) -> str:
    return next(
        f"{seconds * factor:.3g} {unit}"
        for limit, factor, unit in ((1.0, 1, "s"), (1e-3, 1e3, "ms"), (0.0, 1e6, "µs"))
        if seconds >= limit
    )


if __name__ == "__main__":
    main()
