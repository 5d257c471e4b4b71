"""What every `load` does about content that is not as it was written: one error that names the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .errors import DataError, KrosError
from .files import shortened

T = TypeVar("T")


@contextmanager
def as_written(what: str, path: Path) -> Iterator[None]:
    """Turn what content of the wrong kind does to the code that reads it into one error."""
    try:
        yield
    except KrosError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise DataError(
            f"Loading {what} from {path}: not as kros writes it ({type(error).__name__}: {shortened(str(error))}); "
            "write it again with the step "
            "that made it."
        ) from error


def loader(load: Callable[[Any, Any], T]) -> Callable[[Any, Any], T]:
    """Wrap a ``load(cls, path)`` in `as_written`; stands under ``@classmethod``."""

    @wraps(load)
    def guarded(cls: Any, path: Any) -> T:
        with as_written(cls.__name__, Path(path)):
            return load(cls, path)

    return guarded


def check_shapes(
    arrays: Mapping[str, np.ndarray], axes: Mapping[str, str], sizes: Mapping[str, int], path: Path
) -> None:
    """Check arrays against named axes."""
    known = dict(sizes)
    for name, letters in axes.items():
        shape, kind = arrays[name].shape, arrays[name].dtype.kind
        if len(shape) == len(letters):
            for letter, length in zip(letters, shape, strict=True):
                known.setdefault(letter, length)
        if kind not in "biufc" or shape != tuple(known[letter] for letter in letters if letter in known):
            expected = tuple(known.get(letter, letter) for letter in letters)
            raise DataError(
                f"Reading {path}: {name} should hold numbers of shape {expected}, found {arrays[name].dtype} of shape "
                f"{shape}."
            )
