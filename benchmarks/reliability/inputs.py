"""Damaged inputs: every reader and every artifact on mutated files.

A case is a good input, changed at random: bits flipped, bytes lost, doubled or overwritten, lines and keys removed, values of the wrong type, NaN
and huge numbers. It is fine when kros refuses it with an error of its own, or reads what it read before. Text without a checksum may also be
other valid data, and is counted as that; with a checksum that is a silent change. Every other exception, a warning that becomes one, and
whatever takes longer than 20 s is a failure.
"""

from __future__ import annotations

import copy
import json
import random
import shutil
import tempfile
import time
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Tally, main

from kros.core.artifacts import CHECKSUM, load_artifact, plain, read_json, save_artifact
from kros.core.errors import KrosError
from kros.core.lti import StateSpace
from kros.data import Channel, Role, from_arrays, from_frame, read, write_parquet
from kros.data.recording import check_population, usable_episodes
from kros.identify import ModelSet
from kros.lifting import Lifting
from kros.observer import Observer, Runtime
from kros.report.manifest import Artefact, read_manifest, write_manifest
from kros.study.config import load_config, stored_config
from kros.synthesis.result import Injection, Status, Synthesis
from kros.uncertainty import OutlierModel, UncertainModel, quantify, score_outliers

CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("torque", Role.INPUT, "N m"),
)
ODD: tuple[Any, ...] = (
    None,
    True,
    "",
    "x",
    "nan",
    -1,
    0,
    1e308,
    -1e308,
    10**400,
    10**11,
    0.1,
    [],
    {},
    [[]],
    [1, 2, 3],
    "\0",
    "\udcff",
    float("nan"),
    float("inf"),
)
FLAWED = (
    "nan",
    "inf",
    "-inf",
    "1e999",
    "",
    "x",
    "1;2",
    '"',
    '"1',
    "0x10",
    "1e308",
    "--1",
    "\t",
    "\0",
    "ä",
    "1,1",
    "9" * 200,
)


# ------------------------------------------------------------------------------------------------------------------------------ mutations
def mutate_bytes(content: bytes, rng: random.Random) -> bytes:
    """Change a file's bytes in one of several ways."""
    data, at = bytearray(content), rng.randrange(len(content))
    kind = rng.choice(("flip", "flip", "flip", "cut", "lose", "double", "overwrite", "empty", "zeros", "swap"))
    length = rng.choice((1, 2, 7, 64, 500))
    if kind == "flip":
        data[at] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del data[at:]
    elif kind == "lose":
        del data[at : at + length]
    elif kind == "double":
        data[at:at] = data[at : at + length]
    elif kind == "overwrite":
        data[at : at + length] = rng.randbytes(min(length, len(data) - at))
    elif kind == "zeros":
        data[at : at + length] = bytes(min(length, len(data) - at))
    elif kind == "swap":
        other = rng.randrange(len(data))
        data[at], data[other] = data[other], data[at]
    else:
        data.clear()
    return bytes(data)


def mutate_tree(content: Any, rng: random.Random) -> Any:
    """Change one place of nested lists and tables, each depth as often: remove it, double it, or put something odd there."""
    tree = copy.deepcopy(content)
    places: dict[int, list[tuple[Any, Any]]] = {}

    def walk(node: Any, depth: int = 0) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.setdefault(depth, []).append((node, key))
            if isinstance(node[key], (dict, list)):
                walk(node[key], depth + 1)

    walk(tree)
    node, key = rng.choice(rng.choice(list(places.values())))
    kind = rng.choice(("remove", "odd", "odd", "odd", "nest", "rename", "double"))
    if kind == "remove":
        del node[key]
    elif kind == "nest":
        node[key] = [node[key]]
    elif kind == "rename" and isinstance(node, dict):
        node[f"{key}_"] = node.pop(key)
    elif kind == "double" and isinstance(node, list):
        node.insert(key, node[key])
    else:
        node[key] = rng.choice(ODD)
    return tree


def mutate_text(content: bytes, rng: random.Random) -> bytes:
    """Change a table of text: bytes, cells, lines, line ends, columns."""
    if rng.random() < 0.5:
        return mutate_bytes(content, rng)
    lines = content.split(b"\n")
    row = rng.randrange(len(lines))
    kind = rng.choice(
        (
            "cell",
            "cell",
            "drop",
            "double",
            "cr",
            "crlf",
            "header",
            "column",
            "bom",
            "utf16",
            "long",
            "empty line",
            "shuffle",
        )
    )
    cells = lines[row].split(b",")
    if kind == "cell":
        cells[rng.randrange(len(cells))] = rng.choice(FLAWED).encode()
        lines[row] = b",".join(cells)
    elif kind == "drop":
        del lines[row : row + rng.choice((1, 5, 100))]
    elif kind == "double":
        lines.insert(row, lines[row])
    elif kind == "header":
        lines[0] = b",".join([b"position"] * len(lines[0].split(b",")))
    elif kind == "column":
        lines = [b",".join(line.split(b",")[:-1]) for line in lines]
    elif kind == "long":
        lines[row] = b"1" * rng.choice((10_000, 140_000, 5_000_000))
    elif kind == "empty line":
        lines.insert(row, b"")
    elif kind == "shuffle":
        other = rng.randrange(len(lines))
        lines[row], lines[other] = lines[other], lines[row]
    changed = b"\n".join(lines)
    changes = {"cr": lambda: content.replace(b"\n", b"\r"), "crlf": lambda: content.replace(b"\n", b"\r\n")}
    changes |= {"bom": lambda: b"\xef\xbb\xbf" + content, "utf16": lambda: content.decode().encode("utf-16")}
    return changes[kind]() if kind in changes else changed


# -------------------------------------------------------------------------------------------------------------------------------- targets
@dataclass(frozen=True)
class Target:
    """A reader on a good input: how to damage it, how to read it, and whether any other result is a silent change."""

    cases: str
    damage: Callable[[random.Random], Any]
    read: Callable[[Any], Any]
    good: Any
    checked: bool


def samples(seed: int, n: int = 60) -> np.ndarray:
    """A second-order system on noise, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    u, x = rng.normal(size=n), np.zeros((n, 2))
    for k in range(n - 1):
        x[k + 1] = [[1.0, 0.01], [-0.05, 0.95]] @ x[k] + [0.0, 0.1 * u[k]]
    return np.column_stack([x + 1e-3 * rng.normal(size=(n, 2)), u])


def recorded(population: Any) -> Any:
    """Everything that is in a population, for comparison."""
    check_population(population, allow_single=True)
    facts = plain([population.channels, population.sample_period_s, population.units, population.metadata])
    groups = [usable_episodes(population, keys) for _, _, keys in population.groups()]
    return facts, [(str(key), digest) for group in groups for key, _, digest in group]


def matrices(value: Any) -> Any:
    """Anything that was loaded, in a form that can be compared."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, dict):
        return {k: matrices(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [matrices(v) for v in value]
    if hasattr(value, "__dataclass_fields__"):
        return [matrices(getattr(value, f)) for f in value.__dataclass_fields__]
    return repr(value)


class Folder:
    """A copy of a folder in which one file is damaged at a time."""

    def __init__(self, good: Path, names: list[str]) -> None:
        self.good, self.names = good, names
        self.copy = good.with_name(good.name + "_damaged")
        shutil.copytree(good, self.copy)

    def put(self, name: str, content: bytes) -> Path:
        """Damage one file; all others are whole."""
        for other in self.names:
            shutil.copyfile(self.good / other, self.copy / other)
        (self.copy / name).write_bytes(content)
        return self.copy


def folder_target(
    cases: str,
    good: Path,
    read: Callable[[Path], Any],
    mutate: Callable[[str, bytes, random.Random], bytes],
    checked: bool,
) -> Target:
    """A target whose input is a folder of files."""
    names = sorted(str(p.relative_to(good)) for p in good.rglob("*") if p.is_file())
    folder = Folder(good, names)

    def damage(rng: random.Random) -> Path:
        name = rng.choice(names)
        return folder.put(name, mutate(name, (good / name).read_bytes(), rng))

    return Target(cases, damage, read, read(good), checked)


def mutate_file(name: str, content: bytes, rng: random.Random) -> bytes:
    """JSON half the time as a tree, with its checksum in place, so that content is checked too; everything else as bytes."""
    if name.endswith(".json") and rng.random() < 0.5:
        tree = mutate_tree(json.loads(content), rng)
        if isinstance(tree, dict) and rng.random() < 0.5:
            tree.pop(CHECKSUM, None)  # edited on purpose: read as other data where it is valid
        return json.dumps(tree).encode(errors="surrogatepass")
    return mutate_bytes(content, rng)


def csv_file(seed: int) -> bytes:
    """A CSV file with a column of time."""
    values = samples(seed)
    rows = [f"{k * 0.01:.2f},{x:.6f},{v:.6f},{u:.6f}" for k, (x, v, u) in enumerate(values)]
    return ("t,position,velocity,torque\n" + "\n".join(rows) + "\n").encode()


MAPPING: dict[str, Any] = {
    "files": r"(?P<unit>[ab])_(?P<episode>\d+)\.csv",
    "time": "t",
    "channel": [{"name": c.name, "column": c.name, "role": c.role.value, "measured": c.measured} for c in CHANNELS],
    "metadata": {"plant": "x"},
}
STUDY: dict[str, Any] = {
    "name": "s",
    "data": {
        "source": "csv",
        "reader": "csv",
        "csv": MAPPING,
        "prepare": [
            {"step": "trim", "start": 2},
            {"step": "scale", "channels": ["torque"], "factor": 2.0, "unit": "N m"},
            {"step": "differentiate", "channel": "position", "name": "speed", "cutoff_hz": 20.0},
            {"step": "resample", "period_s": 0.02},
        ],
        "exclude": ["a"],
    },
    "lifting": {"functions": ["sin(position)"], "families": [{"kind": "harmonics", "angle": "position", "ratio": 3}]},
    "identify": {"alpha": 90.0, "refine": False},
    "uncertainty": {"form": "additive"},
    "synthesis": {"methods": ["mixed"]},
    "sensor": {"position": {"noise": 1e-3}},
    "evaluate": {"folds": 2},
}


def toml_text(value: Any) -> str:
    """Return a value as TOML writes it inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {toml_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(toml_text(v) for v in value) + "]"
    if isinstance(value, float):
        return repr(value)
    return '""' if value is None else json.dumps(value)


def toml_file(tree: Any) -> bytes:
    """Return tables as a TOML file."""
    return "".join(f"{json.dumps(str(k))} = {toml_text(v)}\n" for k, v in tree.items()).encode(errors="surrogatepass")


def toml_target(cases: str, path: Path, tree: dict[str, Any], read: Callable[[Path], Any]) -> Target:
    """A target whose input is one TOML file."""
    path.write_bytes(toml_file(tree))
    assert tomllib.loads(path.read_text())

    def damage(rng: random.Random) -> Path:
        changed = toml_file(mutate_tree(tree, rng)) if rng.random() < 0.6 else mutate_bytes(toml_file(tree), rng)
        path.write_bytes(changed)
        return path

    return Target(cases, damage, read, read(path), False)


def recordings_targets(root: Path) -> list[Target]:
    """The readers of files."""
    for unit in "ab":
        for episode in range(2):
            path = root / "csv" / f"{unit}_{episode}.csv"
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(csv_file(10 * episode + ord(unit)))
    raw = root / "raw"
    for unit in ("001001",):
        for episode in range(2):
            path = raw / "batch_b" / "population" / f"20230101T000000_{unit}_noload" / f"cycle_{episode:03d}.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            values = samples(int(unit) + 10 * episode, 1040)
            rows = [f"{k * 1e-3:.3f},{x:.4f},{v:.4f},{u:.4f},{x:.3f},{v:.3f}" for k, (x, v, u) in enumerate(values)]
            path.write_text("time,position,velocity,torque,target,speed\n" + "\n".join(rows) + "\n")
    data = {unit: [samples(10 * i + ord(unit)) for i in range(2)] for unit in "ab"}
    write_parquet(from_arrays(data, CHANNELS, 0.01), root / "parquet")
    return [
        folder_target(
            "reader csv",
            root / "csv",
            lambda p: recorded(read(p, "csv", mapping=MAPPING)),
            lambda _, c, r: mutate_text(c, r),
            False,
        ),
        folder_target(
            "reader motor-drive-raw",
            raw,
            lambda p: recorded(read(p, "motor-drive-raw")),
            lambda _, c, r: mutate_text(c, r),
            False,
        ),
        folder_target("reader parquet", root / "parquet", lambda p: recorded(read(p, "parquet")), mutate_file, True),
        toml_target(
            "CSV mapping", root / "mapping.toml", MAPPING, lambda p: recorded(read(root / "csv", "csv", mapping=p))
        ),
    ]


def memory_targets() -> list[Target]:
    """The readers of what is in memory."""
    import pandas as pd

    table = {unit: [samples(10 * i + ord(unit), 30).tolist() for i in range(2)] for unit in "ab"}
    rows = [
        {"unit": u, "condition": "c", "episode": i, **dict(zip("xvu", row, strict=True))}
        for u, e in table.items()
        for i, rows in enumerate(e)
        for row in rows
    ]
    named = (Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE), Channel("u", Role.INPUT))

    def damaged_frame(rng: random.Random) -> Any:
        frame = pd.DataFrame(rows).astype(object)
        kind = rng.choice(("cell", "cell", "column", "drop", "double", "type", "rows"))
        if kind == "cell":
            frame.iat[rng.randrange(len(frame)), rng.randrange(6)] = rng.choice(
                [v for v in ODD if not isinstance(v, (list, dict))]
            )
        elif kind == "drop":
            frame = frame.drop(columns=rng.choice(list(frame.columns)))
        elif kind == "double":
            frame = pd.concat([frame, frame[[rng.choice(list(frame.columns))]]], axis=1)
        elif kind == "type":
            name = rng.choice("xvu")
            frame[name] = frame[name].astype(
                rng.choice(("float16", "float32", "complex128", "str", "datetime64[ns]", "bool", "category", "Float64"))
            )
        elif kind == "rows":
            frame = frame.sample(n=rng.randrange(len(frame)), random_state=rng.randrange(10**6))
        else:
            frame[rng.choice(list(frame.columns))] = pd.Series([rng.choice(ODD)] * len(frame), dtype=object)
        return frame

    def arrays(data: Any) -> Any:
        return recorded(from_arrays(data.get("data"), named, data.get("period")))

    frame_good = recorded(from_frame(pd.DataFrame(rows), named, sample_period_s=0.01))
    good = {"data": table, "period": 0.01}
    return [
        Target("reader arrays", lambda r: mutate_tree(good, r), arrays, arrays(good), False),
        Target(
            "reader frame",
            damaged_frame,
            lambda f: recorded(from_frame(f, named, sample_period_s=0.01)),
            frame_good,
            False,
        ),
    ]


def population_models() -> ModelSet:
    """Four linear models of two states."""
    rng = np.random.default_rng(0)
    A = np.array([[0.9, 0.1], [-0.1, 0.8]]) + 0.01 * rng.normal(size=(4, 2, 2))
    B = np.array([[0.0], [0.1]]) + 0.002 * rng.normal(size=(4, 2, 1))
    lifting = Lifting(("position", "velocity"))
    scales = np.ones(2), np.ones(1)
    return ModelSet("linear", "c", lifting, CHANNELS, 0.01, tuple("abcd"), A, B, {}, *scales, 1.0, status=("ok",) * 4)


def artifact_targets(root: Path) -> list[Target]:
    """What `save` and `load` of the library keep."""
    models = population_models()
    models.save(root / "models")
    freqs = np.geomspace(0.1, 49, 60)
    responses = models.systems().frequency_response(freqs)
    score_outliers(responses, freqs, unit_ids=models.unit_ids).save(root / "outliers")
    quantify(models.systems(), "additive", freqs, max_order=1).save(root / "uncertainty")
    gain = StateSpace(np.zeros((1, 1)), np.ones((1, 1)), np.ones((2, 1)), np.ones((2, 1)), 0.01)
    Synthesis("mixed", gain, Status.OPTIMAL, Injection.STATE, 1.0).save(root / "synthesis")
    lifting = Lifting(("position", "velocity"), ("sin(3*position + phase)",), ("phase",))
    observer = Observer(
        "o",
        lifting,
        np.diag([0.9, 0.8, 0.1]),
        np.ones((3, 1)),
        (0,),
        ("torque",),
        StateSpace(np.eye(2) / 2, np.ones((2, 1)), np.ones((3, 2)), np.ones((3, 1)), 0.01),
        Injection.STATE,
        0.01,
        {"phase": 0.3},
        Runtime(delay=1, lower=np.array([-1.0, -np.inf])),
    )
    (root / "observer").mkdir()
    observer.save(root / "observer" / "deployed.json")
    save_artifact(
        root / "metrics",
        "metrics",
        {"study": {"units": 3}, "rows": [{"unit": "a", "value": 1.5}, {"unit": "b", "value": None}]},
    )

    def target(cases: str, name: str, read: Callable[[Path], Any]) -> Target:
        return folder_target(cases, root / name, lambda p: matrices(read(p)), mutate_file, True)

    return [
        target("observer JSON", "observer", lambda p: Observer.load(p / "deployed.json")),
        target("models (npz and JSON)", "models", ModelSet.load),
        target("outlier model (npz and JSON)", "outliers", OutlierModel.load),
        target("uncertain model (npz and JSON)", "uncertainty", UncertainModel.load),
        target("synthesis (npz and JSON)", "synthesis", Synthesis.load),
        target("stage metrics (JSON with a checksum)", "metrics", lambda p: load_artifact(p, "metrics")[0]),
    ]


def study_targets(root: Path) -> list[Target]:
    """The files of a study."""
    (root / "run").mkdir(parents=True)
    toml = root / "study.toml"
    toml.write_bytes(toml_file(STUDY))
    config = load_config(toml)
    (root / "run" / "study.json").write_text(json.dumps(config.dump()))
    (root / "manifest").mkdir()
    files = {"study.json": ("1" * 64, 100, 10**18)}
    write_manifest(root / "manifest", {"read": Artefact(digest="0" * 64, seconds=0.5, files=files)})

    def stored(folder: Path) -> Any:
        return stored_config(read_json(folder / "study.json"), folder / "study.json").dump()

    return [
        toml_target("study TOML", toml, STUDY, lambda p: load_config(p).dump()),
        folder_target("study.json", root / "run", stored, mutate_file, False),
        folder_target("manifest", root / "manifest", read_manifest, mutate_file, True),
    ]


# ----------------------------------------------------------------------------------------------------------------------------------- cases
def judge(target: Target, tally: Tally, rng: random.Random) -> None:
    """Try one case."""
    damaged = target.damage(rng)
    began = time.perf_counter()
    try:
        found = target.read(damaged)
    except KrosError:
        outcome, failed = "refused with a reason", False
    except Exception as error:
        outcome, failed = f"{type(error).__name__}: {str(error)[:80]}", True
    else:
        if found == target.good:
            outcome, failed = "read as before", False
        elif target.checked and carries_checksum(damaged):
            outcome, failed = "silent change", True
        else:
            outcome, failed = "other valid data", False
    tally.add(outcome, time.perf_counter() - began, failed)


def carries_checksum(folder: Path) -> bool:
    """Whether every JSON file of a folder still has its checksum; without one it counts as edited on purpose."""
    return all(
        isinstance(found := json.loads(p.read_bytes()), dict) and CHECKSUM in found for p in folder.rglob("*.json")
    )


def run(count: int, seed: int) -> list[Tally]:
    """Try `count` damaged inputs of each kind."""
    import logging

    logging.disable(logging.WARNING)
    warnings.simplefilter("error")
    tallies = []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for target in (*recordings_targets(root), *memory_targets(), *artifact_targets(root), *study_targets(root)):
            rng = random.Random(f"{target.cases} {seed}")
            tally = Tally(
                target.cases, "what was read before the damage" + (", under a checksum" if target.checked else "")
            )
            for _ in range(count):
                judge(target, tally, rng)
            tallies.append(tally)
    return tallies


if __name__ == "__main__":
    main("inputs", "Damaged inputs: readers, artifacts and studies", run, 1000)
