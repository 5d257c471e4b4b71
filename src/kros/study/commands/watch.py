"""`kros watch`: new recordings are checked as they arrive, with a line and a result file each, whatever kills it.

A file is checked together with those of its unit that were checked before, where names of files say what a unit is.

The result file is named by the recording, its size and the time of its last change; it is written beside and renamed.
What has one is done, all else is not, and nothing else is remembered. A recording at rest is the same in two looks.
"""

import re
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from ...core import ConfigError, KrosError, digest_of, read_json, write_json
from ...core.files import draft_beside, is_file, link_or_copy, stamp_of
from ...data.readers.parquet import INDEX
from ...report.unit_verdicts import worst
from ..engine.context import Context, open_finished
from ..engine.lock import locked
from ..engine.store import Store, load_run
from .check import verdicts

REFUSED = "refused"  # in place of a verdict
Waiting = dict[Path, Path]  # recordings, a file or a folder of Parquet, by where their results will be


def watch(folder: Path, run: Path, out: Path | None, every_s: float, once: bool) -> Iterator[str]:
    """Yield a line for every recording without a result, once it is at rest; `once`: until all have one."""
    folder = folder.absolute()
    out = folder.with_name(f"{folder.name}-results") if out is None else out.absolute()
    if not folder.is_dir():
        raise ConfigError(f"Watching {folder}: there is no such folder; name the one that recordings arrive in.")
    load_run(run)
    out.mkdir(parents=True, exist_ok=True)
    before: Waiting = {}
    with locked(out):
        Store(out).tidy()
        while (now := waiting(folder, out)) or not once:
            if rest := {place: path for place, path in now.items() if place in before}:
                with open_finished(run) as context:
                    units = by_unit(context, folder)
                    for place, path in rest.items():
                        yield from judged(context, path, place, folder, out, units.get(path, []))
            before = now
            time.sleep(every_s)


def waiting(folder: Path, out: Path) -> Waiting:
    """Return recordings without a result."""
    found: Waiting = {}
    populations = {index.parent for index in folder.rglob(f"{INDEX}.json")}
    files = {path for path in folder.rglob("*") if is_file(path) and populations.isdisjoint(path.parents)}
    for path in sorted(populations | files):
        if out not in path.parents and not path.name.startswith("."):
            with suppress(FileNotFoundError):  # it has just gone
                found[place_of(path, folder, out)] = path
    return {place: path for place, path in found.items() if not place.exists()}


def place_of(path: Path, folder: Path, out: Path) -> Path:
    """Return the file of a result; of a folder of Parquet, the index changes last."""
    changing = path / f"{INDEX}.json" if path.is_dir() else path
    return out / f"{path.relative_to(folder.parent)}.{digest_of(stamp_of(changing))[:12]}.json"


def by_unit(context: Context, folder: Path) -> dict[Path, list[Path]]:
    """Return all files of the unit of a file, by the file, where their names say what a unit is."""
    mapping, units = context.config.data.csv, dict[str, list[Path]]()
    expression = re.compile("" if mapping is None else mapping.files)
    for path in sorted(folder.rglob("*")) if "unit" in expression.groupindex else ():
        if (match := expression.search(path.relative_to(folder).as_posix())) and is_file(path):
            units.setdefault(match["unit"], []).append(path)
    return {path: of for of in units.values() for path in of}


def judged_before(path: Path, folder: Path, out: Path) -> bool:
    """Tell whether a recording, as it is now, has a result and was not refused."""
    with suppress(FileNotFoundError):  # it has just gone
        place = place_of(path, folder, out)
        return place.exists() and read_json(place)["verdict"] != REFUSED
    return False


def judged(
    context: Context, path: Path, place: Path, folder: Path, out: Path, of_unit: Sequence[Path]
) -> Iterator[str]:
    """Check one recording in a folder like its own, and write its result; yield its line, none if it changed."""
    data = path
    with draft_beside(out) as draft:
        try:
            if path.is_file():
                data = draft
                for part in (path, *(other for other in of_unit if judged_before(other, folder, out))):
                    copy = draft / part.relative_to(folder)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    link_or_copy(part, copy)
            rows = verdicts(context, data)
            verdict, reason = str(worst(rows)), "; ".join(row["reason"] for row in rows)
        except (KrosError, OSError) as error:
            verdict, reason, rows = REFUSED, str(error).replace(str(draft), str(folder)), []
    with suppress(FileNotFoundError):
        if place == place_of(path, folder, out):
            recording = str(path.relative_to(folder)).encode(errors="backslashreplace").decode()
            result = {"schema": 1, "recording": recording, "verdict": verdict, "reason": reason, "rows": rows}
            write_json(place, result)
            yield f"{verdict:<9}  {recording}: {reason}"
