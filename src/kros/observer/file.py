"""The file of an observer: JSON that a person can read and write, checked in every part when it is read.

A file that kros wrote carries a checksum of its content. One without, edited by hand, is read all the same, with a
warning: everything below is checked either way.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import CHECKSUM, as_written, check_checksum, plain, read_json, with_checksum, write_json
from ..core.errors import DataError, KrosError
from ..core.files import shortened
from ..core.lti import StateSpace
from ..lifting import Lifting
from ..synthesis.result import Injection
from .data import ObserverData
from .filter_bank import FilterBank
from .guard import Guard
from .monitor import Monitor
from .runtime import Runtime, Seen
from .sensor import Sensor

Array = npt.NDArray[np.float64]
log = logging.getLogger(__name__)
SCHEMA, KIND = 3, "observer"


def observer_content(observer: ObserverData) -> dict[str, Any]:
    """Return what the file of an observer holds, without its checksum."""
    lifting = observer.lifting
    content = {
        "schema": SCHEMA,
        "kind": KIND,
        "name": observer.name,
        "states": lifting.states,
        "lifting": lifting.functions,
        **lifting.extension(),
        "parameters": {k: observer.parameters.get(k) for k in lifting.parameters},
        "inputs": observer.inputs,
        "measured": observer.measured,
        "injection": observer.injection,
        "sample_period_s": observer.sample_period_s,
        "model": {"A": observer.A, "B": observer.B},
        "controller": {key: getattr(observer.controller, key) for key in "ABCD"},
        **observer.runtime.content(),
        **(
            {}
            if observer.seen is None
            else {"seen": {"measured": observer.seen.measured, "inputs": observer.seen.inputs}}
        ),
        **({} if observer.bank is None else {"filter_bank": observer.bank.content()}),
        **({} if observer.guard is None else {"guard": observer.guard.content()}),
        **({"sensor": {name: own.model_dump() for name, own in observer.sensor.items()}} if observer.sensor else {}),
        **({"about": observer.about} if observer.about else {}),
        **({} if observer.monitor is None else {"monitor": observer.monitor.content()}),
    }
    found: dict[str, Any] = plain(content)
    return found


def write_observer(observer: ObserverData, path: Path) -> None:
    """Write an observer; one that could not be read again is refused."""
    content = observer_content(observer)
    observer_from(content, f"Writing observer {observer.name} to {path}")
    write_json(path, with_checksum(content))


def read_observer(path: Path) -> ObserverData:
    """Read an observer's file."""
    content = read_json(path)
    if not isinstance(content, dict) or content.get("kind") != KIND or content.get("schema") != SCHEMA:
        raise DataError(
            f"Loading an observer from {path}: not an observer file of schema {SCHEMA}; write it again with this version of kros."
        )
    if not check_checksum(content, path):
        log.warning("The observer of %s carries no checksum: it was edited.", path)
    try:
        with as_written("Observer", path):
            return observer_from(content, f"Loading an observer from {path}")
    except DataError:
        raise
    except KrosError as error:
        raise DataError(f"Loading an observer from {path}: {error}") from error


def observer_from(content: Mapping[str, Any], where: str) -> ObserverData:
    """Make an observer from the content of a file; messages begin with `where`."""
    _text(content["name"], f"{where}: name")
    for key in ("states", "inputs", "lifting", "lifting_inputs", "input_functions"):
        _names(
            content.get(key, []) if key.endswith(("lifting_inputs", "functions")) else content[key], f"{where}: {key}"
        )
    parameters = _parameters(content["parameters"], where)
    _distinct([*content["states"], *content["inputs"], *content["parameters"]], where)
    lifting = Lifting.from_content(content)
    n, m = lifting.n_lifted, len(content["inputs"]) + len(lifting.input_functions)
    measured = _indices(content["measured"], lifting.n_states, where)
    injection, q = Injection(content["injection"]), len(measured)
    period = content["sample_period_s"]
    _require(
        _is_finite(period) and period > 0, f"{where}: sample_period_s should be a number of seconds above zero", period
    )
    width = m if injection is Injection.INPUT else n
    controller, order = content["controller"], len(content["controller"]["A"])
    shapes = {"A": (order, order), "B": (order, q), "C": (width, order), "D": (width, q)}
    _known(controller, shapes, f"{where}: controller")
    _known(content["model"], "AB", f"{where}: model")
    A, B, C, D = (matrix(controller[key], shapes[key], f"{where}: controller.{key}") for key in "ABCD")
    observer = ObserverData(
        content["name"],
        lifting,
        matrix(content["model"]["A"], (n, n), f"{where}: model.A"),
        matrix(content["model"]["B"], (n, m), f"{where}: model.B"),
        measured,
        tuple(content["inputs"]),
        StateSpace(A, B, C, D, float(period)),
        injection,
        float(period),
        parameters,
        _runtime(content, where),
        _seen(content.get("seen"), q, len(content["inputs"]), where),
        sensor=_sensor(content.get("sensor", {}), where),
        monitor=_monitor(content.get("monitor"), q, where),
        guard=_guard(content.get("guard"), lifting.n_states, order, where),
    )
    optional = ("runtime", "sensor", "filter_bank", "lifting_inputs", "input_functions", "about", CHECKSUM)
    _known(content, [*observer_content(observer), *optional], where)
    about = content.get("about", {})
    _require(isinstance(about, dict), f"{where}: about should be an object", about)
    return replace(observer, bank=_bank(content.get("filter_bank"), lifting.n_states, n + m, q, where), about=about)


def matrix(rows: Any, shape: tuple[int, int], where: str) -> Array:
    """Return a matrix from lists of lists."""
    if not isinstance(rows, list) or len(rows) != shape[0]:
        found = f"{len(rows)} rows" if isinstance(rows, list) else shortened(repr(rows), 60)
        raise DataError(f"{where} should have {shape[0]} rows of {shape[1]} numbers, found {found}; correct the file.")
    for i, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != shape[1]:
            found = f"{len(row)} entries" if isinstance(row, list) else shortened(repr(row), 60)
            raise DataError(f"{where}[{i}] should have {shape[1]} numbers, found {found}; correct the file.")
        for j, value in enumerate(row):
            _require(_is_finite(value), f"{where}[{i}][{j}] should be a finite number", value)
    return np.array(rows, dtype=float).reshape(shape)


def _require(holds: bool, wanted: str, found: Any) -> None:
    if not holds:
        raise DataError(f"{wanted}, found {shortened(repr(found), 60)}; correct the file.")


def _is_finite(value: Any) -> bool:
    """Whether a value is a finite number that a double can hold."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return math.isfinite(value) if isinstance(value, float) else value.bit_length() < 1024


def _text(value: Any, where: str) -> None:
    _require(isinstance(value, str) and bool(value.strip()), f"{where} should be text that is not empty", value)


def _names(values: Any, where: str) -> None:
    _require(isinstance(values, list), f"{where} should be a list of names", values)
    for i, value in enumerate(values):
        _text(value, f"{where}[{i}]")


def _distinct(names: Sequence[str], where: str) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(
            f"{where}: the names of states, inputs and parameters should differ, found {', '.join(twice)} more than once; correct the file."
        )


def _parameters(values: Any, where: str) -> dict[str, float]:
    """Return the values that are known; null stands for one that every unit has of its own."""
    _require(isinstance(values, dict), f"{where}: parameters should name values", values)
    for name, value in values.items():
        _require(
            value is None or _is_finite(value), f"{where}: parameters.{name} should be a finite number or null", value
        )
    return {name: float(value) for name, value in values.items() if value is not None}


def _indices(values: Any, count: int, where: str) -> tuple[int, ...]:
    good = (
        isinstance(values, list)
        and all(type(i) is int and 0 <= i < count for i in values)
        and len(set(values)) == len(values)
    )
    _require(good, f"{where}: measured should list different states by number, 0 to {count - 1}", values)
    return tuple(values)


def _runtime(content: Mapping[str, Any], where: str) -> Runtime:
    found = content.get("runtime", {})
    _known(found, Runtime.__dataclass_fields__, f"{where}: runtime")
    _require(
        type(found.get("relift", True)) is bool, f"{where}: runtime.relift should be true or false", found.get("relift")
    )
    for key, value in found.items():
        entries = [] if key == "relift" else [value]
        while any(isinstance(entry, list) for entry in entries):
            entries = [e for entry in entries for e in (entry if isinstance(entry, list) else [entry])]
        for entry in entries:
            free = entry is None and key != "delay"  # a limit that is null is infinite
            _require(free or _is_finite(entry), f"{where}: runtime.{key} should hold finite numbers", entry)
    return Runtime.from_content(content)


def _seen(found: Any, measured: int, inputs: int, where: str) -> Seen | None:
    if found is None:
        return None
    counts = {"measured": measured, "inputs": inputs}
    _known(found, counts, f"{where}: seen")
    return Seen(*(matrix([found[name]], (1, count), f"{where}: seen.{name}")[0] for name, count in counts.items()))


def _bank(found: Any, n: int, columns: int, measured: int, where: str) -> FilterBank | None:
    if found is None:
        return None
    _known(found, FilterBank.__dataclass_fields__, f"{where}: filter_bank")
    recorded = len(found["forget"]) if isinstance(found["forget"], list) else 0
    counts = {"forget": recorded, "half": recorded, "recovery": recorded, "reach": measured}
    rows = {k: matrix([found[k]], (1, count), f"{where}: filter_bank.{k}")[0] for k, count in counts.items()}
    start = matrix(found["start"], (n, columns), f"{where}: filter_bank.start")
    _require(type(found["filters"]) is int, f"{where}: filter_bank.filters should be a whole number", found["filters"])
    return FilterBank(found["filters"], start, **rows)


def _guard(found: Any, n: int, order: int, where: str) -> Guard | None:
    if found is None:
        return None
    shapes = {"lower": n, "upper": n, "correction": order}
    _known(found, [*shapes, "settle"], f"{where}: guard")
    rows = {name: matrix([found[name]], (1, count), f"{where}: guard.{name}")[0] for name, count in shapes.items()}
    _require(type(found["settle"]) is int, f"{where}: guard.settle should be a whole number", found["settle"])
    return Guard.from_content({**rows, "settle": found["settle"]})


def _sensor(found: Any, where: str) -> dict[str, Sensor]:
    _require(isinstance(found, dict), f"{where}: sensor should be an object", found)
    return {name: Sensor.of(own, f"{where}: sensor.{name}") for name, own in found.items()}


def _monitor(found: Any, measured: int, where: str) -> Monitor | None:
    if found is None:
        return None
    _known(found, Monitor.__dataclass_fields__, f"{where}: monitor")
    rows = {key: len(found[key]) if isinstance(found[key], list) else 0 for key in ("filters",)}
    shapes = {
        "filters": (rows["filters"], 3),
        "limits": (measured, rows["filters"]),
        "weights": (measured, rows["filters"]),
        "size": (1, measured),
    }
    numbers = {
        key: matrix([found[key]] if key == "size" else found[key], shape, f"{where}: monitor.{key}")
        for key, shape in shapes.items()
    }
    plain_ones = {key: value for key, value in found.items() if key not in shapes}
    _require(
        isinstance(found.get("bounds", {}), dict), f"{where}: monitor.bounds should be an object", found.get("bounds")
    )
    for key, value in [*plain_ones.items(), *found.get("bounds", {}).items()]:
        if key == "bounds":
            continue
        _require(_is_finite(value), f"{where}: monitor.{key} should be a finite number", value)
    return Monitor.from_content(plain_ones | numbers | {"size": numbers["size"][0]})


def _known(found: Any, known: Sequence[str] | Mapping[str, Any] | str, where: str) -> None:
    _require(isinstance(found, dict), f"{where} should be an object", found)
    unknown = [key for key in found if key not in known]
    if unknown:
        raise DataError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(known)}; correct the file.")
