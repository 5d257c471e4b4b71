"""The file of an observer: JSON that a person can read and write, checked in every part when it is read.

A file that kros wrote carries a checksum of its content. One without, edited by hand, is read all the same, with a
warning: everything below is checked either way.
"""

from __future__ import annotations

import logging
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, Strict, create_model

from ..core import Array, ByName, DataError, KrosError, Record, Settings, StateSpace, shortened
from ..core.artifacts import CHECKSUM, as_written, check_checksum, plain, read_json, with_checksum, write_json
from ..lifting import Lifting
from .data import ObserverData
from .filter_bank import FilterBank
from .monitor import Monitor
from .runtime import Guard, Runtime, Seen
from .sensor import Sensor

log = logging.getLogger(__name__)
SCHEMA, KIND = 5, "observer"
_PERHAPS = ("lifting_inputs", "input_functions", "sizes", "sensor", "about")  # absent where they are empty
Name = Annotated[str, Field(min_length=1)]
Names = tuple[Name, ...]
Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]


def _even(rows: list[list[float]]) -> Array:
    """Return a matrix; rows of different lengths are refused."""
    if len(lengths := {len(row) for row in rows}) > 1:
        raise ValueError(f"all rows should have the same length, found {sorted(lengths)}")
    return np.array(rows, dtype=float) if rows else np.zeros((0, 0))


Row = Annotated[list[Number], AfterValidator(np.array)]
Matrix = Annotated[list[list[Number]], AfterValidator(_even)]
Limits = list[Number | None]  # null is infinite


class _Part(Settings):
    """What a part of the file holds; numbers are finite."""

    @classmethod
    def _explain(cls, error: Any) -> str:
        text, value = str(error["msg"]).lower(), error.get("input")
        return text if isinstance(value, dict) else f"{text}, found {shortened(repr(value), 60)}"


class _Model(_Part):
    A: Matrix
    B: Matrix


class _Controller(_Model):
    C: Matrix
    D: Matrix


def _part(kind: Any) -> Any:
    """Return what the file holds of a part whose fields are numbers, arrays of them, or numbers by name."""
    types: Record = {"Array": Row | Matrix, "Array | None": Limits, "float": Number, "int": Whole}
    held = Record()
    for f in fields(kind):
        needed = f.default is MISSING and f.default_factory is MISSING
        held[f.name] = (types[str(f.type)], ...) if needed else (types[str(f.type)] | None, None)
    return create_model(f"_{kind.__name__}", __base__=_Part, **held)


_PARTS: Record = {"runtime": Runtime, "seen": Seen, "filter_bank": FilterBank, "guard": Guard, "monitor": Monitor}


def _field(key: str) -> str:
    """Return the observer's field of a part."""
    return key.removeprefix("filter_")


class _File(_Part):
    name: Name
    states: Names
    lifting: Names
    lifting_inputs: Names = ()
    input_functions: Names = ()
    sizes: tuple[tuple[Name, Number], ...] = ()
    parameters: dict[str, Number | None]  # null stands for one that every unit has of its own
    inputs: Names
    measured: tuple[Whole, ...]
    injection: str
    sample_period_s: Number = Field(gt=0)
    model: _Model
    controller: _Controller
    sensor: dict[str, Sensor] = Field(default_factory=dict)
    about: Record = Field(default_factory=dict)


_KINDS: Record = {key: (_part(kind) | None, None) for key, kind in _PARTS.items()}
_Whole = create_model("_Whole", __base__=_File, **_KINDS)


def observer_content(observer: ObserverData) -> Record:
    """Return what the file of an observer holds, without its checksum."""
    lifting = observer.lifting
    parts = {key: getattr(observer, _field(key)) for key in _PARTS}
    content = {
        "schema": SCHEMA,
        "kind": KIND,
        "name": observer.name,
        "states": lifting.states,
        "lifting": lifting.functions,
        "lifting_inputs": lifting.inputs,
        "input_functions": lifting.input_functions,
        "sizes": lifting.sizes,
        "parameters": {k: observer.parameters.get(k) for k in lifting.parameters},
        "inputs": observer.inputs,
        "measured": observer.measured,
        "injection": observer.injection,
        "sample_period_s": observer.sample_period_s,
        "model": {"A": observer.A, "B": observer.B},
        "controller": {key: getattr(observer.controller, key) for key in "ABCD"},
        **{key: _given(vars(part)) for key, part in parts.items() if part is not None},
        "sensor": {name: sensor.model_dump() for name, sensor in observer.sensor.items()},
        "about": observer.about,
    }
    written: Record = plain(content)
    return {key: value for key, value in written.items() if value or key not in _PERHAPS}


def write_observer(observer: ObserverData, path: Path) -> None:
    """Write an observer; one that could not be read again is refused."""
    content = observer_content(observer)
    _checked(content, f"Writing observer {observer.name} to {path}")
    write_json(path, with_checksum(content))


def read_observer(path: Path) -> ObserverData:
    """Read an observer's file."""
    content = read_json(path)
    if not isinstance(content, dict) or content.get("kind") != KIND or content.get("schema") != SCHEMA:
        raise DataError(f"Loading an observer from {path}: not an observer file of schema {SCHEMA}; write it again.")
    if not check_checksum(content, path):
        log.warning("The observer of %s carries no checksum: it was edited.", path)
    with as_written("Observer", path):
        return _checked(content, f"Loading an observer from {path}")


def _checked(content: ByName, where: str) -> ObserverData:
    """Return the observer of a file's content."""
    try:
        rest = {key: value for key, value in content.items() if key not in ("schema", "kind", CHECKSUM)}
        return _observer(_Whole.of(rest, "its content"))
    except KrosError as error:
        raise DataError(f"{where}: {error} Correct the file.") from error


def _observer(file: Any) -> ObserverData:
    names = [*file.states, *file.inputs, *file.parameters]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DataError(f"the names of states, inputs and parameters should differ, found {', '.join(twice)} again.")
    lifting = Lifting(
        file.states, file.lifting, tuple(file.parameters), file.lifting_inputs, file.input_functions, file.sizes
    )
    measured, K = file.measured, file.controller
    if len(set(measured)) < len(measured) or not set(measured) <= set(range(lifting.n_states)):
        raise DataError(
            f"measured should list different states by number, 0 to {lifting.n_states - 1}, found {measured}."
        )
    parts = {key: _given(vars(part)) for key in _PARTS if (part := getattr(file, key)) is not None}
    for name, end in (("lower", -np.inf), ("upper", np.inf)):
        if name in (runtime := parts.get("runtime", {})):
            runtime[name] = [end if limit is None else limit for limit in runtime[name]]
    return ObserverData(
        file.name,
        lifting,
        file.model.A,
        file.model.B,
        measured,
        file.inputs,
        StateSpace(K.A, K.B if K.B.size else np.zeros((len(K.B), len(measured))), K.C, K.D, file.sample_period_s),
        file.injection,
        file.sample_period_s,
        _given(file.parameters),
        sensor=file.sensor,
        about=file.about,
        **{_field(key): _PARTS[key](**part) for key, part in parts.items()},
    )


def _given(fields: ByName) -> Record:
    """Return the fields that are not null."""
    return {name: value for name, value in fields.items() if value is not None}
