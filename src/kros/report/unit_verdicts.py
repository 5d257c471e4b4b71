"""Verdicts of `kros check` in words, and as CSV, HTML and JUnit XML."""

import csv
import io
from collections.abc import Callable, Sequence
from enum import StrEnum
from operator import itemgetter
from pathlib import Path
from xml.etree import ElementTree

from ..core import ConfigError, Record, frozen, grouped, write_bytes
from ..core.artifacts import json_bytes
from ..data import Shown
from ..uncertainty.outliers.score import FEWEST_UNITS, Status
from ..uncertainty.settings import OUTLIER
from .content import Column, Section, build
from .html import filled
from .names import number, readable_unit, words

Rows = list[Record]
_COLUMNS = [
    "verdict",
    "unit",
    "condition",
    "status",
    "score",
    "threshold",
    "level_db",
    "episodes",
    "recorded_s",
    "reason",
]


@frozen
class Check(Shown):
    """What `kros check` says of units: one row of scores with a verdict for every unit and condition."""

    rows: Rows

    def _summary_rows(self) -> Record:
        return {unit: f"{verdict}, {'; '.join(reasons)}" for unit, (verdict, reasons) in by_unit(self.rows).items()}


class Verdict(StrEnum):
    """Verdict on a unit, the worst of its conditions; in the order of severity."""

    PASS = "PASS"
    UNDECIDED = "UNDECIDED"
    FAIL = "FAIL"


def with_verdict(row: Record) -> Record:
    """Return a row of scores with its verdict and the reason in words."""
    passed = all(p <= OUTLIER.passed_percent for p in (row.get("detectable") or {}).values()) and _within(row)
    verdict = Verdict.PASS if row["status"] == Status.OK and passed else Verdict.UNDECIDED
    beyond = not _within(row, OUTLIER.failed) and row["units"] >= FEWEST_UNITS
    verdict = Verdict.FAIL if row["outlier"] or beyond else verdict
    return row | {"verdict": verdict, "reason": "; ".join(_reasons(row))}


def _within(row: Record, factor: float = 1.0) -> bool:
    """Whether the error is at most a factor times its bound, where there is one."""
    ratio = row.get("error", {}).get("ratio", 0.0)
    return ratio is not None and ratio <= factor


def by_unit(rows: Sequence[Record]) -> dict[str, tuple[Verdict, list[str]]]:
    """Return the verdict on every unit, and the reason of every condition."""
    units = grouped(rows, itemgetter("unit"))
    return {u: (worst(of), [f"{row['condition']}: {row['reason']}" for row in of]) for u, of in units.items()}


def worst(rows: Sequence[Record]) -> Verdict:
    """Return the verdict of rows together: FAIL before UNDECIDED before PASS."""
    return max((Verdict(row["verdict"]) for row in rows), key=list(Verdict).index)


def verdict_lines(rows: Sequence[Record]) -> list[str]:
    """Return the word and the name of every unit, each followed by an indented line for every condition."""
    units = by_unit(rows).items()
    return [line for u, (v, reasons) in units for line in (f"{v:<9}  {u}", *(f"  {text}" for text in reasons))]


def csv_text(rows: Rows) -> str:
    """Return a line for every unit and condition."""
    text = io.StringIO()
    table = csv.DictWriter(text, _COLUMNS, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def html_text(rows: Rows) -> str:
    """Return a page with a table of units and conditions."""
    columns = [Column(name) for name in ("unit", "condition", "verdict", "reason")]
    return filled("kros check", worst(rows), [Section("units", "Units", tables=[build("", columns, rows, prose=True)])])


def junit_text(rows: Sequence[Record]) -> str:
    """Return JUnit XML with a test case for every unit; UNDECIDED is an error, so that a build does not pass on it."""
    units, tags = by_unit(rows), {Verdict.FAIL: "failure", Verdict.UNDECIDED: "error"}
    counts = {f"{tag}s": str(sum(v is verdict for v, _ in units.values())) for verdict, tag in tags.items()}
    suite = ElementTree.Element("testsuite", {"name": "kros check", "tests": str(len(units)), **counts})
    for unit, (verdict, reasons) in units.items():
        case = ElementTree.SubElement(suite, "testcase", classname="kros.check", name=_printable(unit))
        if verdict in tags:
            ElementTree.SubElement(case, tags[verdict], type=verdict.value, message=_printable("; ".join(reasons)))
    ElementTree.indent(suite)
    return ElementTree.tostring(suite, "utf-8", xml_declaration=True).decode()


def _printable(text: str) -> str:
    """Return a text in which what cannot be printed is an underscore."""
    return "".join(c if c.isprintable() else "_" for c in text)


def _reasons(row: Record) -> list[str]:
    """Return what a verdict rests on."""
    reasons = []
    if row["score"] is not None and row["threshold"] is not None:
        reasons.append(f"score {row['score']:.2f} dB, threshold {row['threshold']:.2f} dB")
    if row["status"] == Status.NOT_ENOUGH_DATA:
        reasons.append(f"about {row['needed_s']:.3g} s of recordings are needed, found {row['recorded_s']:.3g} s")
    elif row["status"] == Status.OTHER_MOTIONS:
        less = "beyond the others, but by no more than one unit differs from motion to motion"
        reasons.append(f"{less}; repeat the motions of the study")
    elif (gains := row.get("detectable")) and not row["outlier"] and _within(row):
        state, percent = max(gains.items(), key=itemgetter(1))
        only = "only " if row["status"] == Status.CANNOT_TELL or percent > OUTLIER.passed_percent else ""
        reasons.append(f"{only}a change of the gain of {words(state)} above {number(percent, 2)} % would be detected")
    if error := row.get("error"):
        rms, bound = (f"{number(error[key])} {readable_unit(error['unit'])}".strip() for key in ("rms", "bound"))
        reasons.append(f"error of {words(error['state'])} {rms}, at most {bound} expected")
    if "missing" in row:
        reasons.append(f"no score without {', '.join(row['missing'])}")
    elif row["status"] == Status.CANNOT_TELL:
        needs = f"needs about {row['fewest_units']} units that differ as those of the study do, has {row['units']}"
        none = "no number of units that differ as those of the study do would decide: leave out those unlike the others"
        reasons.append(needs if row["fewest_units"] else none)
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


FORMATS: dict[str, Callable[[Rows], str]] = {
    ".csv": csv_text,
    ".html": html_text,
    ".json": lambda rows: json_bytes(rows).decode(),
    ".xml": junit_text,
}


def file_writer(paths: Sequence[Path]) -> Callable[[Rows], None]:
    """Return what writes verdicts to files, by their endings; refuse one that cannot be written."""
    for path in paths:
        if path.is_dir() or not path.absolute().parent.is_dir() or path.suffix not in FORMATS:
            raise ConfigError(f"--out {path}: name a file in an existing folder that ends in {', '.join(FORMATS)}.")

    def write(rows: Rows) -> None:
        for path in paths:
            write_bytes(path, FORMATS[path.suffix](rows).encode())

    return write
