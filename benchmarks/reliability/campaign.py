"""What campaigns share: a tally of what was tried, of what held, and the file that keeps it.

A campaign is a script of this folder with a function ``run(count, seed) -> list[Tally]`` that compares kros with an independent truth on
random or damaged inputs. Its results lie in ``results/<name>.json``; ``page.py`` writes ``docs/reliability.md`` from all of them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
LONGEST_S = 20.0  # a case that takes longer counts as a hang


@dataclass
class Tally:
    """Counts of one kind of case.

    `truth` names what the results were compared with. `outcomes` counts what is fine ("optimal", "refused with a reason", "resumed to the
    same bytes"), `failures` what is not ("false bound", "traceback", "hang", "silent change").
    """

    cases: str
    truth: str
    tried: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    note: str = ""

    def add(self, outcome: str, seconds: float = 0.0, failed: bool = False) -> None:
        """Count one case; one that takes too long is a failure whatever it returned."""
        self.tried += 1
        self.slowest_s = max(self.slowest_s, seconds)
        if seconds > LONGEST_S:
            outcome, failed = "hang", True
        (self.failures if failed else self.outcomes)[outcome] += 1


def main(name: str, title: str, run: Callable[[int, int], list[Tally]], count: int) -> None:
    """Run a campaign from the command line and keep its result."""
    parser = argparse.ArgumentParser(description=title)
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    began = time.perf_counter()
    tallies = run(options.count, options.seed)
    result = {
        "title": title,
        "seed": options.seed,
        "seconds": round(time.perf_counter() - began, 1),
        "tallies": [vars(t) for t in tallies],
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1, sort_keys=True) + "\n")
    for tally in tallies:
        print(
            f"{tally.cases}: {tally.tried} tried, {dict(tally.outcomes)}, failures {dict(tally.failures)}, slowest {tally.slowest_s:.2f} s"
        )
