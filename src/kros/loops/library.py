"""The compiled time loops, called with arrays by name."""

from __future__ import annotations

import ctypes
import logging
import os
import re
from functools import cache, lru_cache
from importlib.resources import files
from typing import Any

import numpy as np

from ..core import ByName, ConfigError, Parameters, Record
from ..lifting import Lifting
from ..lifting.program import Program
from .compiler import load

_log = logging.getLogger(__name__)
_FLAGS = (
    "-std=gnu11",
    "-O2",
    "-march=native",
    "-fPIC",
    "-shared",
    "-fno-math-errno",
    "-ffp-contract=off",
)  # no fused products: NumPy has none
_TYPES = {"double": np.float64, "int32_t": np.int32, "uint8_t": np.uint8, "whole": np.int64}
CHOICE, CHOICES = "KROS_LOOPS", ("compiled", "numpy")


class Library:
    """Functions of a C source whose arguments are structs of 64-bit numbers and pointers."""

    def __init__(self, code: ctypes.CDLL, source: str) -> None:
        self._code = code
        self._types: dict[str, dict[str, tuple[Any, bool] | None]] = {}
        for body, name in re.findall(r"typedef struct \{(.*?)\} (\w+);", source, re.DOTALL):
            fields = re.findall(r"^\s+(const )?(\w+) (\*?)(\w+);", body, re.MULTILINE)
            self._types[name] = {
                field: (_TYPES[kind], not given) if pointer else None for given, kind, pointer, field in fields
            }

    def call(self, name: str, *jobs: tuple[str, ByName]) -> None:
        """Call a function with structs by type: numbers and arrays by field, nothing for a field that is left out."""
        alive: list[Any] = []  # arrays that were made here live until the call is over
        structs = [self._struct(type_, values, alive) for type_, values in jobs]
        if self._code[name](*structs):
            raise MemoryError(f"Time loop {name}: there is no memory left for its state.")

    def _struct(self, type_: str, values: ByName, alive: list[Any]) -> ctypes.Array[ctypes.c_int64]:
        fields = self._types[type_]
        unknown = values.keys() - fields.keys()
        assert not unknown, unknown
        return (ctypes.c_int64 * len(fields))(
            *(self._slot(values.get(field), kind, alive) for field, kind in fields.items())
        )

    @staticmethod
    def _slot(value: Any, pointer: tuple[Any, bool] | None, alive: list[Any]) -> int:
        if value is None or pointer is None:
            return int(value or 0)
        array = np.ascontiguousarray(value, dtype=pointer[0])
        assert array is value or not pointer[1], "a copy would be written into"
        alive.append(array)
        return array.ctypes.data


@cache
def library() -> Library | None:
    """Return the compiled loops; None with ``KROS_LOOPS=numpy``, or without a compiler that works."""
    choice = os.environ.get(CHOICE, CHOICES[0])
    if choice not in CHOICES:
        raise ConfigError(f"{CHOICE}={choice}: should be one of {', '.join(CHOICES)}.")
    if choice == "numpy":
        return None
    source = files(__package__).joinpath("loops.c").read_text(encoding="utf-8")
    code = load(source, _FLAGS)
    return None if code is None else Library(code, source)


def formulas(
    lifting: Lifting, values: Parameters | None, m: int, batch: int, entries: tuple[int, ...] = ()
) -> tuple[str, Record]:
    """Return what the loops need to know of a lifting with m recorded inputs and parameters of shape (batch,)."""
    given = lifting.parameter_values(values)
    own = np.array([np.broadcast_to(given[name], (batch,)) for name in lifting.parameters])
    return "formulas", {**_tape(lifting, m, entries), "values": own}


@lru_cache
def _tape(lifting: Lifting, m: int, entries: tuple[int, ...]) -> Record:
    """Return the formulas of a lifting, and their slopes by entries of the window, as one program."""
    window, n, n_lifted = lifting.window, lifting.n_states, lifting.n_lifted
    inputs = lifting.inputs or tuple(f"input {i}" for i in range(m))  # which no formula can read
    formulas = [(n + i, formula) for i, formula in enumerate(lifting.formulas)]
    of = [(n_lifted + m + i, formula) for i, formula in enumerate(lifting.input_formulas)]
    slopes = [
        (column, place, formula.derivative(window.names[entry]))
        for column, formula in formulas + of
        for place, entry in enumerate(entries)
    ]
    slopes = [row for row in slopes if row[2] != 0]
    trees = [formula.expression for _, formula in formulas + of] + [tree for _, _, tree in slopes]
    program = Program.of(trees, (*window.names, *inputs, *lifting.parameters))
    functions, gamma, moved = np.split(program.outputs, np.cumsum([len(formulas), len(of)]))
    places = np.array([(column, place) for column, place, _ in slopes]).reshape(-1, 2)
    return {
        "n": n,
        "earlier": len(window.earlier),
        "m": m,
        "parameters": len(lifting.parameters),
        "registers": program.registers,
        "constants": len(program.constants),
        "operations": len(program.code),
        "slopes": len(slopes),
        "constant": program.constants,
        "code": program.code,
        "lifted": np.concatenate([np.arange(n), functions, np.arange(m) + len(window.names), gamma]),
        "n_lifted": n_lifted,
        "n_inputs": m + len(gamma),
        "shift": window.shift,
        "present": window.present,
        "slope": np.column_stack([places, moved]),
    }
