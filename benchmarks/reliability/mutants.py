"""Mutation testing: small changes of the code that proves and judges, each of which some fast test should notice.

    pip install cosmic-ray                                    (anywhere on the PATH; it is not among the project's own dependencies)
    python benchmarks/reliability/mutants.py --count 300      (in a checkout of its own: files are changed while it runs)

Mutants are drawn with a fixed seed from all that cosmic-ray makes of the packages below, in proportion to their number. Changes inside
annotations are left out: nothing evaluates them. A mutant meets the fast tests that run its line, the quickest first, up to `BUDGET_S` of them; a
line that runs while modules are imported meets those that run anything of its file. One that no test notices is listed with its line.

What was found is kept in ``mutants.jsonl`` in the working directory, and a run goes on from there: remove the lines of survivors to try these again.
"""

from __future__ import annotations

import ast
import json
import os
import random
import re
import signal
import sqlite3
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

from campaign import Tally, main

ROOT = Path(__file__).parents[2]
KNOWN = Path("mutants.jsonl").absolute()
BUDGET_S = 40.0
PYTEST = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow"]
PLACES = (
    "src/kros/synthesis/worst_case",
    "src/kros/uncertainty/weights",
    "src/kros/observer/certificate",
    "src/kros/evaluate/errors.py",
)
TESTS = (
    "synthesis_worst_case synthesis_forms synthesis_lower_bounds synthesis_shaping synthesis_parts synthesis_problem synthesis_errors "
    "uncertainty_weights uncertainty_cover uncertainty_entrywise uncertainty_certificate uncertainty_diagonal uncertainty_fit uncertainty_check "
    "uncertainty_quantify uncertainty_residuals evaluate_errors evaluate_spectra observer_certificate* "
    "design_certificates"
)
Mutant = dict[str, Any]
Seconds = dict[str, float]
Lines = dict[str, dict[int, set[str]]]


def run(count: int, seed: int) -> list[Tally]:
    """Draw mutants, test each that is not known yet, and tell which survived."""
    with tempfile.TemporaryDirectory() as folder:
        found = [mutant for place in PLACES for mutant in _mutants(Path(folder), place)]
        chosen = random.Random(seed).sample(found, min(count, len(found)))
        known = (
            {line["name"]: line for line in map(json.loads, KNOWN.read_text().splitlines())} if KNOWN.exists() else {}
        )
        if any(_name(m) not in known for m in chosen):
            seconds, lines = _covered(Path(folder))
            for mutant in chosen:
                if _name(mutant) not in known:
                    known[_name(mutant)] = {
                        "name": _name(mutant),
                        **_tried(mutant, _selected(mutant, seconds, lines), seconds),
                    }
                    with KNOWN.open("a") as file:
                        file.write(json.dumps(known[_name(mutant)]) + "\n")
    tallies = {place: Tally(f"mutants of `{place}`", "fast tests that run the line") for place in PLACES}
    for mutant in chosen:
        outcome, tally = known[_name(mutant)]["outcome"], tallies[mutant["place"]]
        tally.add(outcome)
        if outcome == "survived":
            tally.note += f"- `{mutant['path']}:{mutant['row']}` {known[_name(mutant)]['change']}\n"
    return list(tallies.values())


def _mutants(folder: Path, place: str) -> list[Mutant]:
    """Return the mutants of a package that change what runs, in a fixed order."""
    config, session = folder / "config.toml", folder / f"{place.replace('/', '_')}.sqlite"
    config.write_text(
        f'[cosmic-ray]\nmodule-path = "{place}"\ntimeout = 1.0\nexcluded-modules = []\ntest-command = "true"\n[cosmic-ray.distributor]\nname = "local"\n'
    )
    subprocess.run(["cosmic-ray", "init", config, session], check=True, cwd=ROOT, capture_output=True)
    columns = "module_path, operator_name, occurrence, start_pos_row, start_pos_col"
    query = f"select {columns} from mutation_specs order by module_path, operator_name, operator_args, occurrence"
    with closing(sqlite3.connect(session)) as database:
        rows = database.execute(query).fetchall()
    keys = ("path", "operator", "occurrence", "row", "column")
    found = [{"place": place, **dict(zip(keys, row, strict=True))} for row in rows]
    return [
        m for m in found if not any(start <= (m["row"], m["column"]) < end for start, end in _annotations(m["path"]))
    ]


def _name(mutant: Mutant) -> str:
    return f"{mutant['path']}:{mutant['operator']}:{mutant['occurrence']}"


@cache
def _tree(path: str) -> ast.Module:
    return ast.parse((ROOT / path).read_text(encoding="utf-8"))


@cache
def _annotations(path: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    nodes = ast.walk(_tree(path))
    notes = [
        n
        for node in nodes
        for n in (getattr(node, "annotation", None), getattr(node, "returns", None))
        if isinstance(n, ast.expr)
    ]
    return [((n.lineno, n.col_offset), (n.end_lineno or n.lineno, n.end_col_offset or n.col_offset)) for n in notes]


def _covered(folder: Path) -> tuple[Seconds, Lines]:
    """Run the fast tests once; return how long each that passes takes, and which of them run a line of a file."""
    files = [
        str(f.relative_to(ROOT)) for name in TESTS.split() for f in sorted((ROOT / "tests").glob(f"*/test_{name}.py"))
    ]
    data = folder / "coverage"
    wide = [f"--cov={Path(place).parent if place.endswith('.py') else place}" for place in PLACES]
    options = [*wide, "--cov-context=test", "--cov-report=", "--durations=0", "--durations-min=0", "-vv", "-rN"]
    done = subprocess.run(
        [*PYTEST, *options, *files],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=os.environ | {"COVERAGE_FILE": str(data)},
        check=False,
    )
    passed = set(re.findall(r"^(tests/\S+::.+?) PASSED", done.stdout, re.MULTILINE))
    seconds: Seconds = defaultdict(float)
    for value, test in re.findall(r"^\s*([\d.]+)s (?:call|setup)\s+(tests/\S+::.+)$", done.stdout, re.MULTILINE):
        if test in passed:
            seconds[test] += float(value)
    from coverage import CoverageData

    measured, lines = CoverageData(str(data)), Lines()
    measured.read()
    for file in measured.measured_files():
        by_line = measured.contexts_by_lineno(file)
        lines[str(Path(file).relative_to(ROOT))] = {
            row: {c.partition("|")[0] for c in found} - {""} for row, found in by_line.items()
        }
    return dict(seconds), lines


def _selected(mutant: Mutant, seconds: Seconds, lines: Lines) -> list[str]:
    """Return the tests that run a mutant's statement, the quickest first, within the budget."""
    here, rows = lines.get(mutant["path"], {}), _statement(mutant["path"], mutant["row"])
    found: set[str] = set().union(*(here.get(row, set()) for row in rows))
    found = found or (set().union(*here.values()) if any(row in here for row in rows) else set())
    selected, total = [], 0.0
    for test in sorted((t for t in found if t in seconds), key=lambda t: (seconds[t], t)):
        total += seconds[test]
        if total > BUDGET_S:
            break
        selected.append(test)
    return selected


def _statement(path: str, row: int) -> range:
    """Return the lines of the innermost statement around a line; of one that holds others, its head."""

    def spans(node: ast.AST) -> Iterator[range]:
        for child in ast.walk(node):
            if isinstance(child, ast.stmt | ast.ExceptHandler):
                body = getattr(child, "body", None)
                end = body[0].lineno - 1 if isinstance(body, list) and body else child.end_lineno
                yield range(child.lineno, max(child.lineno, end or child.lineno) + 1)

    return min((span for span in spans(_tree(path)) if row in span), key=len, default=range(row, row + 1))


def _tried(mutant: Mutant, tests: Sequence[str], seconds: Seconds) -> dict[str, Any]:
    """Change the file, run the tests, and put it back; tests that take five times as long as before, and a minute, have noticed."""
    path = ROOT / mutant["path"]
    original = path.read_text(encoding="utf-8")
    try:
        change = ["cosmic-ray", "apply", mutant["path"], mutant["operator"], str(mutant["occurrence"])]
        subprocess.run(change, cwd=ROOT, check=True, capture_output=True)
        changed = path.read_text(encoding="utf-8").splitlines()
        pairs = zip(original.splitlines(), changed, strict=False)
        text = next((f"{a.strip()} -> {b.strip()}" for a, b in pairs if a != b), "nothing")
        noticed = bool(tests) and _fails(tests, 60 + 5 * sum(seconds[t] for t in tests))
    finally:
        path.write_text(original, encoding="utf-8")
    return {"outcome": "noticed" if noticed else "survived", "change": text, "row": mutant["row"], "tests": len(tests)}


def _fails(tests: Sequence[str], limit_s: float) -> bool:
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as names:
        names.write("\n".join(tests))
        names.flush()
        process = subprocess.Popen(
            [*PYTEST, "-x", f"@{names.name}"],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            return process.wait(limit_s) != 0
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return True


if __name__ == "__main__":
    main("mutants", "Mutation testing", run, 300)
