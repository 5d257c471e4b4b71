"""Damaged inputs, tried on the commands: every case runs `kros` in a forked process on recordings, a study or a run folder with one flaw.

A case is fine when the command ends within a minute with exit code 0, 2, 3 or 4, or with 1 and a reason that is not a defect of kros, prints no
traceback and no warning of NumPy, and leaves no output behind where it failed.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from campaign import Tally, main
from inputs import FLAWED, mutate_bytes, mutate_text, mutate_tree

from kros.cli import app
from kros.core.artifacts import CHECKSUM, with_checksum
from kros.data import write_parquet
from kros.plants import PLANTS

LONGEST_S = 60
WRITTEN = "out"  # name of every output
Damage = Callable[[Path, random.Random], None]
QUICK = (
    "identify.refine=false",
    'synthesis.methods=["residual_h2"]',
    "uncertainty.n_freqs=60",
)
STUDY = """name = "drives"
[data]
source = "csv"
reader = "csv"
[data.csv]
files = '(?P<unit>u[0-9]+)_(?P<episode>[0-9]+)[.]csv'
time = "time"
channel = [
    {name = "angle", column = "angle", role = "state", unit = "rad", measured = true, scale = 0.017453292519943295},
    {name = "speed", column = "speed", role = "state", unit = "rad/s"},
    {name = "torque", column = "torque", role = "input", unit = "N m"},
]
"""


# ------------------------------------------------------------------------------------------------------------------------------ damages
def pick(folder: Path, rng: random.Random, ending: str = "") -> Path:
    """Return one of a folder's files."""
    return rng.choice(sorted(p for p in folder.rglob(f"*{ending}") if p.is_file() and p.stat().st_size))


def rewrite(path: Path, content: bytes) -> None:
    """Write a file anew; the copy may be a link to the good one."""
    path.unlink()
    path.write_bytes(content)


def on_bytes(change: Callable[[bytes, random.Random], bytes], ending: str = "") -> Damage:
    """Damage the content of one file."""

    def damage(folder: Path, rng: random.Random) -> None:
        path = pick(folder, rng, ending)
        rewrite(path, change(path.read_bytes(), rng))

    return damage


def column_of(content: bytes, rng: random.Random, change: Callable[[list[bytes], random.Random], list[bytes]]) -> bytes:
    """Change the cells of every line alike."""
    seed = rng.random()
    return b"\n".join(b",".join(change(line.split(b","), random.Random(seed))) for line in content.split(b"\n"))


def swapped(content: bytes, rng: random.Random) -> bytes:
    """Two columns change places."""
    return column_of(content, rng, lambda cells, r: r.sample(cells, len(cells)))


def huge(content: bytes, rng: random.Random) -> bytes:
    """One column holds numbers of another size."""
    factor, where = rng.choice((b"e300", b"e-300", b"e30", b"e308", b"e15")), rng.randrange(4)

    def change(cells: list[bytes], _: random.Random) -> list[bytes]:
        number = len(cells) > where and cells[where][-1:].isdigit()
        return [c + factor if number and i == where else c for i, c in enumerate(cells)]

    return column_of(content, rng, change)


def flawed_cells(content: bytes, rng: random.Random) -> bytes:
    """Some cells are no numbers."""
    lines = content.split(b"\n")
    for _ in range(rng.choice((1, 3, 40))):
        row = rng.randrange(1, len(lines))
        cells = lines[row].split(b",")
        cells[rng.randrange(len(cells))] = rng.choice(FLAWED).encode()
        lines[row] = b",".join(cells)
    return b"\n".join(lines)


def constant(content: bytes, rng: random.Random) -> bytes:
    """One column is the same everywhere: zero, a step, time that stands."""
    where, value = rng.randrange(4), rng.choice((b"0", b"1", b"-1e9", b"nan", b""))
    head, *rest = content.split(b"\n")
    return b"\n".join(
        [head, *(b",".join(value if i == where else c for i, c in enumerate(row.split(b","))) for row in rest if row)]
    )


def encoded(content: bytes, rng: random.Random) -> bytes:
    """Text in another encoding, or none."""
    text = content.decode("latin-1")
    return rng.choice(
        (
            text.encode("utf-16"),
            text.encode("utf-32"),
            text.encode("utf-7"),
            b"\xff\xfe" + content,
            content[::-1],
            b"\x1f\x8b" + content,
        )
    )


def nested(content: bytes, rng: random.Random) -> bytes:
    """Depth in place of content."""
    n = rng.choice((50, 70, 5000, 100_000))
    return rng.choice(
        (
            b"[" * n,
            b'{"a":' * n,
            b"[" * n + b"]" * n,
            b"a = " + b"[" * n + b"]" * n,
            b"a." * n + b"b = 1",
            content + b"\n[" + b"x." * n + b"y]",
        )
    )


def doubled_keys(content: bytes, rng: random.Random) -> bytes:
    """A line of the file stands twice: keys of TOML, rows of a table, keys of JSON."""
    lines = content.split(b"\n")
    row = rng.randrange(len(lines))
    return b"\n".join([*lines[: row + 1], *lines[row:]])


def toml_tokens(content: bytes, rng: random.Random) -> bytes:
    """A value or a name of a TOML file is another."""
    words = (
        "-1",
        "0",
        "1e308",
        "nan",
        "inf",
        '""',
        '"x"',
        "[]",
        "{}",
        "true",
        "9" * 30,
        '"../.."',
        '"\\u0000"',
        "1979-05-27",
        "[[]]",
        "'*/'",
        '"("',
    )
    spans = list(re.finditer(rb"(?<=[=\[,])\s*(\"[^\"]*\"|'[^']*'|[\w.-]+)|^\w+", content, re.MULTILINE))
    span = rng.choice(spans)
    return content[: span.start()] + b" " + rng.choice(words).encode() + content[span.end() :]


def more_toml(content: bytes, rng: random.Random) -> bytes:
    """Sections and keys that no study would have."""
    keys = (
        "identify.alpha",
        "uncertainty.n_freqs",
        "uncertainty.form",
        "split.test_fraction",
        "evaluate.folds",
        "evaluate.reserve",
        "data.exclude",
    )
    keys += (
        "synthesis.methods",
        "synthesis.noise",
        "sensor.angle.noise",
        "sensor.angle.dropout",
        "limits.speed",
        "calibrate.angle",
    )
    keys += (
        "lifting.functions",
        "lifting.families",
        "estimator.delays",
        "estimator.order",
        "data.prepare",
        "data.source",
        "identify.kinds",
        "load.moment",
    )
    values = (
        "-1",
        "0",
        "1e308",
        "nan",
        "inf",
        '"x"',
        "[]",
        "{}",
        "true",
        '["sin("]',
        '["angle**999"]',
        '["1/angle"]',
        '["exp(exp(speed))"]',
        "[[1,2]]",
    )
    values += (
        '[{step = "trim", start = 10000000}]',
        '[{step = "resample", period_s = 1e-9}]',
        '[{step = "scale", channels = ["torque"], factor = 0}]',
    )
    key = rng.choice(keys)
    section, _, name = key.rpartition(".")
    return content + f"\n[{section}]\n{name} = {rng.choice(values)}\n".encode()


def tree(content: bytes, rng: random.Random) -> bytes:
    """JSON with one place changed, half the time with a checksum that fits."""
    changed = mutate_tree(json.loads(content), rng)
    if isinstance(changed, dict) and rng.random() < 0.7:
        with contextlib.suppress(Exception):
            changed = with_checksum({k: v for k, v in changed.items() if k != CHECKSUM})
    return json.dumps(changed).encode(errors="surrogatepass")


def not_a_file(folder: Path, rng: random.Random) -> None:
    """Something else stands in a file's or a folder's place."""
    path = pick(folder, rng)
    path = rng.choice([path, path, *(p for p in path.parents if p.is_relative_to(folder) and p != folder)])
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    kind = rng.choice(("gone", "folder", "loop", "dangling", "pipe", "device", "empty", "to parent", "long name"))
    if kind == "folder":
        (path / "in").mkdir(parents=True)
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "dangling":
        path.symlink_to(folder / "nowhere")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to(rng.choice(("/dev/zero", "/dev/null", "/proc/self/mem", "/proc/kcore", "/dev/tty")))
    elif kind == "empty":
        path.touch()
    elif kind == "to parent":
        path.symlink_to(folder, target_is_directory=True)
    elif kind == "long name":
        (path.parent / ("x" * 250)).write_bytes(b"1,2\n")


def mixed(folder: Path, rng: random.Random) -> None:
    """Files of the folder change places, within one kind or not."""
    for _ in range(rng.choice((1, 1, 4))):
        ending = rng.choice(("", "", ".json", ".npz", ".parquet", ".csv"))
        try:
            one, two = pick(folder, rng, ending), pick(folder, rng, ending)
        except IndexError:
            continue
        a, b = one.read_bytes(), two.read_bytes()
        rewrite(one, b)
        rewrite(two, a)


def digests(content: bytes, rng: random.Random) -> bytes:
    """A digest of the file is another."""
    found = list(re.finditer(rb"[0-9a-f]{64}", content))
    if not found:
        return mutate_bytes(content, rng)
    at = rng.choice(found).start()
    return content[:at] + rng.choice((b"0", b"f", b"A", b"g")) + content[at + 1 :]


def nothing(folder: Path, rng: random.Random) -> None:
    """Leave the inputs whole, which every command has to accept."""


WHOLE = "whole"
TABLES: dict[str, Damage] = {
    "truncated, flipped, doubled bytes": on_bytes(mutate_bytes, ".csv"),
    "cells, lines, headers": on_bytes(mutate_text, ".csv"),
    "columns that changed places": on_bytes(swapped, ".csv"),
    "numbers of another size": on_bytes(huge, ".csv"),
    "cells that are no numbers": on_bytes(flawed_cells, ".csv"),
    "columns that stand still": on_bytes(constant, ".csv"),
    "other encodings": on_bytes(encoded, ".csv"),
    "lines twice": on_bytes(doubled_keys, ".csv"),
    "no files: folders, loops, pipes, devices": not_a_file,
    "files that changed places": mixed,
}
PARQUET: dict[str, Damage] = {
    "truncated, flipped, doubled bytes": on_bytes(mutate_bytes),
    "JSON of another shape": on_bytes(tree, ".json"),
    "digests": on_bytes(digests, ".json"),
    "no files: folders, loops, pipes, devices": not_a_file,
    "files that changed places": mixed,
}
TOML: dict[str, Damage] = {
    "values and names": on_bytes(toml_tokens),
    "sections that no study has": on_bytes(more_toml),
    "truncated, flipped, doubled bytes": on_bytes(mutate_bytes),
    "keys twice": on_bytes(doubled_keys),
    "depth": on_bytes(nested),
    "other encodings": on_bytes(encoded),
    "no files: folders, loops, pipes, devices": not_a_file,
}
RUN: dict[str, Damage] = {
    "truncated, flipped, doubled bytes": on_bytes(mutate_bytes),
    "JSON of another shape": on_bytes(tree, ".json"),
    "depth": on_bytes(nested, ".json"),
    "keys twice": on_bytes(doubled_keys, ".json"),
    "digests": on_bytes(digests, ".json"),
    "other encodings": on_bytes(encoded, ".json"),
    "no files: folders, loops, pipes, devices": not_a_file,
    "files that changed places": mixed,
}


# -------------------------------------------------------------------------------------------------------------------------------- cases
def command(arguments: Sequence[str], folder: Path) -> tuple[int | None, str]:
    """Run `kros` in a forked process; exit code (None after a minute, below zero for a signal) and what it printed."""
    log = folder / "printed"
    child = os.fork()
    if child == 0:
        os.setsid()
        os.chdir(folder)
        out = os.open(log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        code = 99
        try:
            app(list(arguments), prog_name="kros")
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else 0 if left.code is None else 98
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    ends = time.monotonic() + LONGEST_S
    while time.monotonic() < ends:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), log.read_text(errors="replace")
        time.sleep(0.005)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None, log.read_text(errors="replace")


def verdict(code: int | None, printed: str, written: bool) -> tuple[str, bool]:
    """Return what became of a case, and whether that is a failure."""
    if code is None:
        return "hang", True
    if "Traceback" in printed or "Internal error" in printed or code in (98, 99):
        return "traceback: " + printed.strip().splitlines()[-1][:200], True
    if heard := re.search(
        r".*(RuntimeWarning|warning: (divide by zero|overflow|underflow|invalid value|Mean of empty|Degrees of freedom)).*",
        printed,
    ):
        return f"NumPy warning: {heard[0][:200]}", True
    if code not in (0, 1, 2, 3, 4):
        return f"exit code {code}", True
    if code == 1 and "kros: " not in printed:
        return "no reason", True
    if code in (1, 2) and written:
        return "half written", True
    return {
        0: "done",
        1: "failed with a reason",
        2: "refused with a reason",
        3: "done, flagged",
        4: "done, cannot tell",
    }[code], False


def linked(good: Path, copy: Path) -> None:
    """Copy a folder by links; damage replaces files and never writes into one."""
    shutil.copytree(good, copy, copy_function=os.link, symlinks=True)


def recordings(root: Path) -> None:
    """Write recordings of simulated motors, as CSV files in degrees and as Parquet, and a study of them that has run."""
    population = PLANTS["dc-motor"](n_units=4, n_episodes=3, seconds=1.5, seed=11).simulate().population
    write_parquet(population, root / "parquet")
    (root / "csv").mkdir()
    (root / "toml").mkdir()
    names = [c.name for c in population.channels]
    columns = [
        names.index("position"),
        names.index("velocity") if "velocity" in names else 1,
        next(i for i, n in enumerate(names) if "voltage" in n),
    ]
    for n, key in enumerate(population.episodes):
        values = population.read(key)[:, columns] * [180 / np.pi, 1, 1]
        time_s = population.sample_period_s * np.arange(len(values))
        path = root / "csv" / f"u{n // 3}_{n % 3}.csv"
        np.savetxt(path, np.column_stack([time_s, values]), "%.9g", ",", header="time,angle,speed,torque", comments="")
    (root / "toml" / "study.toml").write_text(STUDY.replace('source = "csv"', f'source = "{root / "csv"}"'))


def run(count: int, seed: int) -> list[Tally]:
    """Try `count` flaws of every kind with every command."""
    from kros.study.engine import executors  # noqa: F401  # what commands import late is imported once
    from kros.study.stages import report  # noqa: F401

    tallies: list[Tally] = []
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        recordings(root)
        options = [word for text in QUICK for word in ("--set", text)]
        code, printed = command(
            ["run", str(root / "toml" / "study.toml"), "--out", str(root / "run"), "--workers", "1", *options], root
        )
        assert code == 0, printed
        until = ["--workers", "1", "--out", WRITTEN]
        run_csv = [
            "run",
            str(root / "toml" / "study.toml"),
            "--set",
            "data.source={place}/case",
            "--until",
            "identify",
            *until,
        ]
        groups: list[tuple[str, Path, dict[str, Damage], list[list[str]]]] = [
            (
                "CSV",
                root / "csv",
                TABLES,
                [["init", "case", "--out", WRITTEN, "--measured", "angle", "--input", "torque"], run_csv],
            ),
            (
                "CSV in the field",
                root / "csv",
                TABLES,
                [["check", "run", "field.toml"], ["estimate", "run", "field.toml", f"{WRITTEN}.csv"]],
            ),
            (
                "Parquet",
                root / "parquet",
                PARQUET,
                [["run", "parquet.toml", "--until", "read", *until]],
            ),
            (
                "TOML",
                root / "toml",
                TOML,
                [["run", "case/study.toml", "--until", "calibrate", *until], ["check", "run", "case/study.toml"]],
            ),
            (
                "run folders",
                root / "run",
                RUN,
                [
                    ["list", "case"],
                    ["export", "c", "case", WRITTEN],
                    ["export", "fmu", "case", f"{WRITTEN}.fmu"],
                    ["estimate", "case", "field.toml", f"{WRITTEN}.parquet"],
                    ["check", "case", "field.toml", "--workers", "1"],
                    ["report", "case"],
                    [
                        "run",
                        str(root / "toml" / "study.toml"),
                        "--out",
                        "case",
                        "--until",
                        "identify",
                        "--workers",
                        "1",
                        *options,
                    ],
                ],
            ),
        ]
        for inputs, good, damages, commands in groups:
            damages = {WHOLE: nothing, **damages}
            for kind, damage in damages.items():
                rng = random.Random(f"{inputs} {kind} {seed}")
                tally = Tally(f"{inputs}: {kind}", "an end within a minute, a reason, nothing half written")
                for k in range(len(commands) if kind == WHOLE else count):
                    with tempfile.TemporaryDirectory(dir=root) as scratch:
                        place = Path(scratch)
                        linked(good, place / "case")
                        (place / "run").symlink_to(root / "run")
                        source = "case" if inputs == "CSV in the field" else str(root / "csv")
                        (place / "field.toml").write_text(STUDY.replace('source = "csv"', f'source = "{source}"'))
                        (place / "parquet.toml").write_text('[data]\nsource = "case"\nreader = "parquet"\n')
                        try:
                            damage(place / "case", rng)
                        except (UnicodeDecodeError, json.JSONDecodeError, IndexError):
                            continue
                        chosen = [word.replace("{place}", str(place)) for word in commands[k % len(commands)]]
                        began = time.perf_counter()
                        code, printed = command(chosen, place)
                        own = [p for p in place.iterdir() if p.name.lstrip(".").startswith(WRITTEN)]
                        outcome, failed = verdict(code, printed, bool(own))
                        assert kind != WHOLE or code in (0, 3, 4), f"{chosen} fails on whole inputs: {printed}"
                        tally.add(
                            outcome if not failed else f"{' '.join(chosen[:2])}: {outcome}",
                            time.perf_counter() - began,
                            failed,
                        )
                tallies.append(tally)
                if tally.failures:
                    print(tally.cases, dict(tally.failures), flush=True)
    return tallies


if __name__ == "__main__":
    main("commands", "Damaged inputs: the commands", run, 30)
