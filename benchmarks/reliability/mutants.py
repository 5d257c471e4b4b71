"""Mutation testing: small changes of the code that proves and judges, each of which some fast test should notice.

    pip install cosmic-ray                                    (anywhere on the PATH; it is not among the project's own dependencies)
    python benchmarks/reliability/mutants.py --count 300      (in a checkout of its own: files are changed while it runs)

Mutants are drawn with a fixed seed from all that cosmic-ray makes of the packages below, in proportion to their number. Changes inside
annotations are left out: nothing evaluates them. A mutant that no test of its package notices is listed with its line.
"""

from __future__ import annotations

import ast
import json
import random
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

from campaign import Tally, main

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 120.0
FAST = f"{sys.executable} -m pytest -q -x -p no:cacheprovider -m 'not slow'"
TESTS = {
    "src/kros/synthesis/worst_case": "synthesis_shaping synthesis_worst_case synthesis_forms synthesis_lower_bounds",
    "src/kros/uncertainty/weights": "uncertainty_weights uncertainty_cover uncertainty_entrywise uncertainty_certificate",
    "src/kros/observer/certificate": "design_certificates observer_certificate",
    "src/kros/evaluate/errors.py": "evaluate_errors evaluate_spectra",
}


def run(count: int, seed: int) -> list[Tally]:
    """Draw mutants, test each, and tell which survived."""
    with tempfile.TemporaryDirectory() as folder:
        sessions = {place: _session(Path(folder), place, _files(names)) for place, names in TESTS.items()}
        found = [(place, job) for place, session in sessions.items() for job in _jobs(session)]
        chosen = random.Random(seed).sample(found, min(count, len(found)))
        return [_tested(place, session, {job for p, job in chosen if p == place}) for place, session in sessions.items()]


def _files(names: str) -> str:
    found = [str(f.relative_to(ROOT)) for name in names.split() for f in sorted((ROOT / "tests").glob(f"*/test_{name}.py"))]
    return " ".join(found)


def _session(folder: Path, place: str, tests: str) -> Path:
    """Return a cosmic-ray session with all mutants of a package."""
    name = place.replace("/", "_")
    config = folder / f"{name}.toml"
    lines = {"module-path": place, "timeout": TIMEOUT_S, "excluded-modules": [], "test-command": f"{FAST} {tests}"}
    table = "".join(f"{key} = {json.dumps(value)}\n" for key, value in lines.items())
    config.write_text(f'[cosmic-ray]\n{table}[cosmic-ray.distributor]\nname = "local"\n')
    session = folder / f"{name}.sqlite"
    subprocess.run(["cosmic-ray", "init", config, session], check=True, cwd=ROOT, capture_output=True)
    return session


def _jobs(session: Path) -> list[str]:
    """Return the mutants that change what runs, in a fixed order."""
    query = "select job_id, module_path, start_pos_row, start_pos_col from mutation_specs order by module_path, operator_name, operator_args, occurrence"
    with closing(sqlite3.connect(session)) as database:
        rows = database.execute(query).fetchall()
    spans = {path: _annotations(ROOT / path) for path in {row[1] for row in rows}}
    return [job for job, path, row, column in rows if not any(start <= (row, column) < end for start, end in spans[path])]


def _annotations(path: Path) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    notes = [n for node in nodes for n in (getattr(node, "annotation", None), getattr(node, "returns", None)) if isinstance(n, ast.expr)]
    return [((n.lineno, n.col_offset), (n.end_lineno or n.lineno, n.end_col_offset or n.col_offset)) for n in notes]


def _tested(place: str, session: Path, jobs: set[str]) -> Tally:
    tally = Tally(f"mutants of `{place}`", "the package's fast tests")
    with closing(sqlite3.connect(session)) as database, database:
        for table in ("mutation_specs", "work_items"):
            database.execute(f"delete from {table} where job_id not in ({','.join('?' * len(jobs))})", sorted(jobs))
    if jobs:
        subprocess.run(["cosmic-ray", "exec", session.with_suffix(".toml"), session], check=True, cwd=ROOT)
    query = "select test_outcome, module_path, start_pos_row, operator_name from work_results join mutation_specs using (job_id)"
    with closing(sqlite3.connect(session)) as database:
        for outcome, path, row, operator in database.execute(query):
            tally.add("survived" if outcome == "SURVIVED" else "noticed")
            if outcome == "SURVIVED":
                tally.note += f"- `{path}:{row}` {operator.removeprefix('core/')}\n"
    return tally


if __name__ == "__main__":
    main("mutants", "Mutation testing", run, 300)
