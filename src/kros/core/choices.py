"""Members of enumerations by their names, converted where they enter."""

from __future__ import annotations

from enum import Enum
from typing import TypeVar

from .errors import ConfigError

E = TypeVar("E", bound=Enum)


def member(kind: type[E], value: E | str, what: str) -> E:
    """Return the member of an enumeration by its name, or raise a `ConfigError` that lists the names."""
    try:
        return kind(value)
    except ValueError as error:
        names = ", ".join(str(m.value) for m in kind)
        raise ConfigError(f"{what} {value!r} is unknown; choose one of {names}.") from error
