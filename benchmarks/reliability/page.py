"""Writes docs/reliability.md from the results of the campaigns: what was tried, against which truth, with counts.

    python benchmarks/reliability/page.py

A campaign whose result changed changes the page; a test compares the two.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from campaign import LONGEST_S, RESULTS

SHORT = {"refused with a reason": "refused", ", resumed to the same bytes": "", "H-infinity optimum, ": ""}
PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
INTRODUCTION = f"""# Reliability

*How was kros tested for wrong results, beyond its own tests?*

```console
$ python benchmarks/reliability/formulas.py --seed 1
```

Each campaign runs kros on random, damaged or adversarial inputs and compares the results with an independent truth. A
case fails if a bound is false, if an exception other than those of kros occurs, or if a change of the input remains
unreported. A case that takes longer than {LONGEST_S:g} s fails, too. *Refused* means with a reason; runs that are
killed are resumed to the same bytes. `benchmarks/reliability/page.py` generates this page
from `benchmarks/reliability/results`, where notes on single rows are.

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
    missing = f"\nNot run for this version: {', '.join(f'`{name}.py`' for name in waiting)}.\n" if waiting else ""
    return INTRODUCTION + summary + missing + "".join(_campaign(name, result) for name, result in results.items())


def _campaign(name: str, result: dict[str, Any]) -> str:
    """Return a section: the truths that a campaign compares with, and a row for each of its kinds of cases."""
    tallies = result["tallies"]
    truths = dict.fromkeys(tally["truth"] for tally in tallies)
    rows = "".join(_row(tally) for tally in tallies)
    command = f"`{name}.py --seed {result['seed']}`, {result['seconds'] / 60:.1f} minutes on one core."
    head = "| cases | number | outcomes, and failures if there are any |\n|---|---|---|\n"
    return f"\n## {result['title']}\n\n{command} Compared with: {'; '.join(truths)}.\n\n{head}{rows}"


def _row(tally: dict[str, Any]) -> str:
    failures = {f"FAILED, {name}": count for name, count in tally["failures"].items()}
    cells = [tally["cases"], str(tally["tried"]), _counts(tally["outcomes"] | failures)]
    row = f"| {' | '.join(cells)} |\n"
    for long, short in SHORT.items():
        row = row.replace(long, short)
    return row


def _counts(counts: dict[str, int]) -> str:
    return "; ".join(f"{name}: {count}" for name, count in sorted(counts.items(), key=lambda item: -item[1]))


if __name__ == "__main__":
    main()
