"""The verdict on every unit that `kros check` scored, PASS, FAIL or UNDECIDED, as text and JUnit XML."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from ...core.errors import ConfigError
from ...uncertainty.outliers.score import FEWEST_UNITS, Status


class Verdict(StrEnum):
    """Verdict on a unit, the worst of its conditions; in the order of severity."""

    PASS = "PASS"
    UNDECIDED = "UNDECIDED"
    FAIL = "FAIL"


def with_verdict(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of scores with its verdict and the reason in words."""
    verdict = Verdict.PASS if row["status"] == Status.OK else Verdict.UNDECIDED
    return row | {"verdict": Verdict.FAIL if row["outlier"] else verdict, "reason": "; ".join(_reasons(row))}


def by_unit(rows: Sequence[dict[str, Any]]) -> dict[str, tuple[Verdict, list[str]]]:
    """Return the verdict on every unit, and the reason of every condition."""
    units: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        units.setdefault(row["unit"], []).append(row)
    return {u: (worst(of), [f"{row['condition']}: {row['reason']}" for row in of]) for u, of in units.items()}


def worst(rows: Sequence[dict[str, Any]]) -> Verdict:
    """Return the verdict of rows together: FAIL before UNDECIDED before PASS."""
    return max((Verdict(row["verdict"]) for row in rows), key=list(Verdict).index)


def verdict_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the word and the name of every unit, each followed by an indented line for every condition."""
    units = by_unit(rows).items()
    return [line for u, (v, reasons) in units for line in (f"{v:<9}  {u}", *(f"  {text}" for text in reasons))]


def require_folder(path: Path) -> None:
    """Refuse a file that cannot be written, before anything is computed."""
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ConfigError(f"--junit {path}: is not a file in an existing folder; name one.")


def junit_text(rows: Sequence[dict[str, Any]]) -> str:
    """Return JUnit XML with a test case for every unit; UNDECIDED is an error, so that a build does not pass on it."""
    units, tags = by_unit(rows), {Verdict.FAIL: "failure", Verdict.UNDECIDED: "error"}
    counts = {tag: sum(v is verdict for v, _ in units.values()) for verdict, tag in tags.items()}
    numbers = f'tests="{len(units)}" failures="{counts["failure"]}" errors="{counts["error"]}"'
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<testsuite name="kros check" {numbers}>']
    for unit, (verdict, reasons) in units.items():
        message = f"type={_quoted(verdict)} message={_quoted('; '.join(reasons))}"
        inside = f"<{tags[verdict]} {message}/>" if verdict in tags else ""
        lines.append(f'  <testcase classname="kros.check" name={_quoted(unit)}>{inside}</testcase>')
    return "\n".join([*lines, "</testsuite>", ""])


def _quoted(text: str) -> str:
    """Return an attribute of XML; what cannot be printed becomes an underscore."""
    return quoteattr("".join(c if c.isprintable() else "_" for c in text))


def _reasons(row: dict[str, Any]) -> list[str]:
    """Return what a verdict rests on."""
    reasons = []
    if row["score"] is not None and row["threshold"] is not None:
        reasons.append(f"score {row['score']:.2f} dB, threshold {row['threshold']:.2f} dB")
    if row["status"] == Status.NOT_ENOUGH_DATA:
        reasons.append(f"about {row['needed_s']:.3g} s of recordings are needed, found {row['recorded_s']:.3g} s")
    elif row["status"] == Status.CANNOT_TELL and "missing" not in row and row["units"] < FEWEST_UNITS:
        reasons.append(f"needs at least {FEWEST_UNITS} units to compare with, has {row['units']}")
    elif row["status"] == Status.OTHER_MOTIONS:
        less = "beyond the others, but by no more than one unit differs from motion to motion"
        reasons.append(f"{less}; repeat the motions of the study")
    elif row.get("detectable") is not None and not row["outlier"]:
        only = "only " if row["status"] == Status.CANNOT_TELL else ""
        change = f"{only}a change of gain above {row['detectable']:.2g} % would be detected"
        reasons.append(f"{change}, at {row['detectable_hz']:.3g} Hz")
    if "missing" in row:
        reasons.append(f"no score without {', '.join(row['missing'])}")
    if row.get("level_db") is not None:
        few = f", from {row['level_units']} units of which {FEWEST_UNITS} are needed"
        place = f"{abs(row['level_db']):.2f} dB {'over' if row['level_db'] > 0 else 'below'} the monitor's bound"
        reasons.append(f"innovation {place}{few if row['level_units'] < FEWEST_UNITS else ''}")
    elif "missing" in row:
        reasons.append("the deployed observer has no monitor, or no sample can be judged")
    if row["left_out"]:
        reasons.append(f"compared without {', '.join(row['left_out'])}, which is the same machine")
    reasons += [f"{count} samples {bit}" for bit, count in row.get("samples", {}).items()]
    return reasons + ([f"parameters {row['parameters']}"] if row.get("parameters") else [])
