"""Strict reading of TOML tables into frozen dataclasses: unknown and missing keys and wrong types are errors that name the place."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from enum import Enum
from typing import Any, TypeVar

from ..core.errors import ConfigError
from ..core.files import did_you_mean

T = TypeVar("T")


def build(kind: type[T], table: Mapping[str, Any], where: str) -> T:
    """Make a dataclass from a table."""
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where}: should be a table, found {table!r}; correct it.")
    fields = [f for f in dataclasses.fields(kind) if f.init]  # type: ignore[arg-type]
    known = [f.name for f in fields]
    unknown = [key for key in table if key not in known]
    if unknown:
        raise ConfigError(
            f"{where}: unknown key {unknown[0]!r}{did_you_mean(unknown[0], known) or ';'} known keys are {', '.join(known)}."
        )
    missing = [
        f.name
        for f in fields
        if f.name not in table and f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigError(f"{where}: key {missing[0]!r} is missing, found {list(table)}; add it.")
    hints = typing.get_type_hints(kind)
    return kind(**{key: _convert(value, hints[key], f"{where}: {key}") for key, value in table.items()})


def _convert(value: Any, hint: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return _convert_union(value, arguments, where)
    if origin is typing.Literal and value in arguments:
        return value
    if origin is tuple and isinstance(value, (list, tuple)):
        return tuple(_convert(item, arguments[0], f"{where}[{i}]") for i, item in enumerate(value))
    if isinstance(origin, type) and issubclass(origin, Mapping) and isinstance(value, Mapping):
        return {str(key): _convert(item, arguments[1], f"{where}.{key}") for key, item in value.items()}
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return build(hint, value, where)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _convert_enum(value, hint, where)
    if hint is Any or (isinstance(hint, type) and _fits(value, hint)):
        return _float(value, where) if hint is float else value
    raise ConfigError(f"{where}: should be {_word(hint)}, found {value!r}; correct it.")


def _float(value: float, where: str) -> float:
    try:
        return float(value)
    except OverflowError as error:
        raise ConfigError(
            f"{where}: should be a number that fits 64 bits, found one of {value.bit_length()} bits; correct it."
        ) from error  # type: ignore[attr-defined]


def _convert_union(value: Any, arguments: tuple[Any, ...], where: str) -> Any:
    for option in arguments:
        try:
            return _convert(value, option, where)
        except ConfigError:
            continue
    raise ConfigError(
        f"{where}: should be {' or '.join(_word(a) for a in arguments if a is not type(None))}, found {value!r}; correct it."
    )


def _convert_enum(value: Any, kind: type[Enum], where: str) -> Enum:
    try:
        return kind(value)
    except ValueError as error:
        raise ConfigError(
            f"{where}: should be one of {[member.value for member in kind]}, found {value!r}; correct it."
        ) from error


def _fits(value: Any, kind: type) -> bool:
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, (int, float)) if kind is float else isinstance(value, kind)


def _word(hint: Any) -> str:
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(repr(value) for value in typing.get_args(hint))
    words = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}
    return words.get(hint, "a list" if typing.get_origin(hint) is tuple else "a table")
