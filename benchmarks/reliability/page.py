"""Writes docs/reliability.md from the results of the campaigns: what was tried, against which truth, with counts.

    python benchmarks/reliability/page.py

A campaign whose result changed changes the page; a test compares the two.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from campaign import LONGEST_S, RESULTS

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
INTRODUCTION = f"""# Reliability: what was tried

What kros states was tested against independent truths on random, damaged and adversarial inputs. This page is written by `benchmarks/reliability/page.py`
from the results of the campaigns in that folder, each of which can be run again, with another `--seed` or `--count`. A case that takes longer than
{LONGEST_S:g} s counts as a failure, as do a false bound, an exception other than kros's own with a reason, and a change that nobody is told of.

"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(render(), encoding="utf-8")


def render() -> str:
    """Return the page's text."""
    results = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(RESULTS.glob("*.json"))}
    tried = sum(tally["tried"] for result in results.values() for tally in result["tallies"])
    failed = sum(sum(tally["failures"].values()) for result in results.values() for tally in result["tallies"])
    summary = f"**{tried} cases in {len(results)} campaigns, {failed} failures.**\n"
    waiting = sorted({path.stem for path in Path(__file__).parent.glob("*.py")} - results.keys() - {"campaign", "page"})
    missing = (
        f"\nWithout a result in this version: {', '.join(f'`{name}.py`' for name in waiting)}.\n" if waiting else ""
    )
    return INTRODUCTION + summary + missing + "".join(_campaign(name, result) for name, result in results.items())


def _campaign(name: str, result: dict[str, Any]) -> str:
    rows = "".join(_row(tally) for tally in result["tallies"])
    notes = "".join(
        f"\n{tally['cases'].capitalize()}: {tally['note'].strip()}\n" for tally in result["tallies"] if tally["note"]
    )
    command = f"`python benchmarks/reliability/{name}.py --seed {result['seed']}`, {result['seconds'] / 60:.1f} minutes on one core"
    head = "| cases | compared with | tried | outcomes | failures | slowest (s) |\n|---|---|---|---|---|---|\n"
    return f"\n## {result['title']}\n\n{command}\n\n{head}{rows}{notes}"


def _row(tally: dict[str, Any]) -> str:
    cells = [
        tally["cases"],
        tally["truth"],
        str(tally["tried"]),
        _counts(tally["outcomes"]),
        _counts(tally["failures"]),
    ]
    return f"| {' | '.join(cells)} | {tally['slowest_s']:.2g} |\n"


def _counts(counts: dict[str, int]) -> str:
    return "; ".join(f"{name}: {count}" for name, count in sorted(counts.items(), key=lambda item: -item[1])) or "none"


if __name__ == "__main__":
    main()
