"""Formulas of a lifting, and of their slopes, as one program for the compiled loops."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..core.arrays import Array
from ..lifting import Lifting
from ..lifting.program import Codes, Program


@dataclass(frozen=True, eq=False)
class Tape:
    """Operations of a lifting."""

    constants: Array  # shape (constants,)
    code: Codes  # shape (operations, 4): kind, register of the result, registers of the operands
    lifted: Codes  # shape (n_lifted + inputs,): registers of the lifted states, then of the inputs and their functions
    slopes: Codes  # shape (slopes, 3): column of a model, entry, and register of every derivative that is not zero
    registers: int


@lru_cache
def tape_of(lifting: Lifting, m: int, entries: tuple[int, ...] = ()) -> Tape:
    """Return the tape of a lifting with m recorded inputs."""
    window, n, n_lifted = lifting.window.names, lifting.n_states, lifting.n_lifted
    inputs = lifting.inputs or tuple(f"input {i}" for i in range(m))  # which no formula can read
    formulas = [(n + i, formula) for i, formula in enumerate(lifting.formulas)]
    of = [(n_lifted + m + i, formula) for i, formula in enumerate(lifting.input_formulas)]
    slopes = [
        (column, place, formula.derivative(window[entry]))
        for column, formula in formulas + of
        for place, entry in enumerate(entries)
    ]
    slopes = [row for row in slopes if row[2] != 0]
    trees = [formula.expression for _, formula in formulas + of] + [tree for _, _, tree in slopes]
    program = Program.of(trees, (*window, *inputs, *lifting.parameters))
    functions, gamma, moved = np.split(program.outputs, np.cumsum([len(formulas), len(of)]))
    given = np.arange(len(window), len(window) + m)
    lifted = np.concatenate([np.arange(n), functions, given, gamma]).astype(np.int32)
    places = np.array([(column, place) for column, place, _ in slopes], dtype=np.int32).reshape(-1, 2)
    return Tape(program.constants, program.code, lifted, np.column_stack([places, moved]), program.registers)
