"""The coordinates of a pykoop pipeline and those of kros: from one to the other without a constant term.

A pipeline predicts ``z+ = A z + B v`` with lifted states ``z = (affine in x, functions of x, constants)`` and lifted inputs ``v``. A kros
model has the states themselves first, functions after them, and no constant:

    z = T theta(x - x_offset) + c,   v_affine = V (u - u_offset) + d      gives      theta+ = P A T theta + P B [V u; gamma]

with ``P T = I``. Scalers are folded into T and V, their centres into the offsets; a constant term (a constant lifting function, a scaler
behind other functions) disappears in the shift ``c`` that solves ``(I - A) c - B V u = constant``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, IdentificationError
from ..lifting import Lifting
from ..lifting.formula import base_and_delay
from .adopted import AdoptedModel
from .pykoop_formulas import LiftedColumns, exact, text, walk

Array = npt.NDArray[np.float64]

_NOTHING = 1e-12  # relative constant term that is rounding


@dataclass(frozen=True, eq=False)
class Reading:
    """How a pipeline's lifted states become those of the model, ``theta = P (z[kept] - c)``, and the sizes of its states and inputs."""

    kept: list[int]
    c: Array
    P: Array
    input_size: Array

    def __call__(self, z: Array) -> Array:
        """Return the model's lifted states."""
        return np.asarray((z[:, self.kept] - self.c) @ self.P.T)

    def state_size(self, n_states: int) -> Array:
        """Return how far a state moves when the pipeline's scaled states move by one."""
        return np.asarray(np.abs(self.P[:n_states, :n_states]).sum(axis=1))


def translate(pipeline: Any, names: tuple[str, ...], input_names: tuple[str, ...]) -> tuple[AdoptedModel, Reading]:
    """Return the model, and how its lifted states are read from those of the pipeline."""
    import sympy as sp

    x, u = [sp.Symbol(s, real=True) for s in names], [sp.Symbol(s, real=True) for s in input_names]
    lifted = walk(pipeline.lifting_functions_, LiftedColumns(tuple(x), tuple(u)))
    coefficients = np.asarray(pipeline.regressor_.coef_, dtype=float).T
    p, n = len(lifted.states), len(x)
    if coefficients.shape != (p, p + len(lifted.inputs)):
        raise IdentificationError(
            f"from_pykoop: the Koopman matrix has shape {coefficients.shape}, the lifting gives {p} states and {len(lifted.inputs)} inputs; "
            "the regressor does not belong to this pipeline."
        )
    constant = [i for i, column in enumerate(lifted.states) if not column.free_symbols]
    kept = [i for i in range(p) if i not in constant]
    affine = [j for j, column in enumerate(lifted.inputs) if _is_affine(column, u)]
    other = [j for j in range(len(lifted.inputs)) if j not in affine]
    if kept[:n] != list(range(n)) or not all(_is_affine(lifted.states[i], x) for i in range(n)):
        raise IdentificationError("from_pykoop: the first lifted states are not the scaled states, so the state cannot be read off.")
    A, B = coefficients[np.ix_(kept, kept)], coefficients[np.ix_(kept, [p + j for j in affine])]
    S, s0 = _linear_part(lifted.states[:n], x)
    V, d = _linear_part([lifted.inputs[j] for j in affine], u)
    rest = coefficients[np.ix_(kept, constant)] @ np.array([float(lifted.states[i]) for i in constant])
    c, u_offset = _shift(A, B, V, d, rest)
    inverse = S.inv()
    x_offset = list(inverse * (sp.Matrix([exact(value) for value in c[:n]]) - s0)) if n else []
    offsets = dict(zip((*names, *input_names), (*x_offset, *u_offset), strict=True))
    everything = set().union(*(column.free_symbols for column in (*lifted.states, *lifted.inputs)))
    moved = {symbol: symbol + offsets[base_and_delay(symbol.name)[0]] for symbol in everything}
    functions, T, P = _functions([lifted.states[i].xreplace(moved) - exact(c[k]) for k, i in enumerate(kept) if k >= n], S, inverse)
    gamma, G = _input_functions([lifted.inputs[j].xreplace(moved) for j in other], input_names)
    V_float = np.array(V.tolist(), dtype=float).reshape(len(affine), len(u))
    whole = np.concatenate([B @ V_float, coefficients[np.ix_(kept, [p + j for j in other])] @ G], axis=1)
    model = AdoptedModel(
        lifting=Lifting(names, functions, (), input_names if gamma else (), gamma),
        inputs=input_names,
        A=P @ A @ T,
        B=P @ whole,
        state_offset=np.array([float(value) for value in x_offset]),
        input_offset=np.asarray(u_offset, dtype=float),
    )
    return model, Reading(kept, c, P, 1 / np.abs(V_float).max(axis=0, initial=np.finfo(float).tiny))


def _is_affine(column: Any, symbols: list[Any]) -> bool:
    """Whether a column is affine in these symbols and depends on nothing else."""
    import sympy as sp

    if not column.free_symbols <= set(symbols):
        return False
    return all(not sp.diff(column, symbol).free_symbols for symbol in symbols)


def _linear_part(columns: Sequence[Any], symbols: list[Any]) -> tuple[Any, Any]:
    """Return exact matrices with ``columns = M symbols + m``."""
    import sympy as sp

    M = sp.Matrix(len(columns), len(symbols), lambda i, j: sp.diff(columns[i], symbols[j]))
    zero = dict.fromkeys(symbols, sp.Integer(0))
    return M, sp.Matrix(len(columns), 1, lambda i, j: columns[i].xreplace(zero))


def _shift(A: Array, B: Array, V: Any, d: Any, rest: Array) -> tuple[Array, list[Any]]:
    """Return shifts of lifted states and inputs that leave no constant term.

    The inputs are first moved to where the pipeline's scaled inputs are zero; what is left, if anything, moves states and inputs as
    little as possible.
    """
    n_inputs = V.shape[1]
    V_float = np.array(V.tolist(), dtype=float).reshape(V.shape)
    centre = list((V.T * V).LUsolve(-V.T * d)) if n_inputs else []
    left = d + V * _column(centre) if n_inputs else d
    constant = rest + B @ np.array([float(value) for value in left]) if len(left) else rest
    if not constant.any():
        return np.zeros(len(A)), centre
    matrix = np.concatenate([np.eye(len(A)) - A, -B @ V_float], axis=1)
    solution = np.linalg.lstsq(matrix, constant, rcond=None)[0]
    missing = np.abs(matrix @ solution - constant).max()
    if missing > 1e-10 * np.abs(constant).max():
        if np.abs(constant).max() <= _NOTHING * np.abs(A).sum(axis=1).max():
            return np.zeros(len(A)), centre
        raise IdentificationError(
            f"from_pykoop: the pipeline adds a constant of {np.abs(constant).max():.3g} to the lifted states at every step, and no shift of states "
            f"and inputs removes it ({missing:.3g} is left); leave out the constant lifting function, or scale before lifting."
        )
    return solution[: len(A)], [value + exact(move) for value, move in zip(centre, solution[len(A) :], strict=True)]


def _column(values: list[Any]) -> Any:
    import sympy as sp

    return sp.Matrix(len(values), 1, values)


def _functions(columns: list[Any], S: Any, inverse: Any) -> tuple[tuple[str, ...], Array, Array]:
    """Return formulas without factors or repetitions, and T and P with ``columns = T theta``, ``P T = I``."""
    n = S.shape[0]
    formulas: dict[str, int] = {}
    places = []
    for row, column in enumerate(columns):
        factor, function = column.as_coeff_Mul()
        formula = text(function)
        places.append((formula, float(factor)))
        formulas.setdefault(formula, row)
    order = list(formulas)
    T = np.zeros((n + len(columns), n + len(order)))
    P = np.zeros(T.shape[::-1])
    T[:n, :n], P[:n, :n] = np.array(S.tolist(), dtype=float), np.array(inverse.tolist(), dtype=float)
    for row, (formula, scale) in enumerate(places):
        column_at = n + order.index(formula)
        T[n + row, column_at] = scale
        if formulas[formula] == row:
            P[column_at, n + row] = 1 / scale
    return tuple(order), T, P


def _input_functions(columns: list[Any], inputs: tuple[str, ...]) -> tuple[tuple[str, ...], Array]:
    """Return formulas of the inputs without factors or repetitions, and G with ``columns = G gamma``."""
    pairs = [column.as_coeff_Mul() for column in columns]
    formulas = [text(function) for _, function in pairs]
    order = list(dict.fromkeys(formulas))
    read = [{base_and_delay(symbol.name)[0] for symbol in function.free_symbols} for _, function in pairs]
    idle = [formula for formula, names in zip(formulas, read, strict=True) if not names & set(inputs)]
    if idle:
        raise ConfigError(
            f"from_pykoop: the pipeline takes {idle[0]!r}, which depends on no input, for an input; lift the states by themselves."
        )
    G = np.zeros((len(columns), len(order)))
    G[range(len(columns)), [order.index(formula) for formula in formulas]] = [float(factor) for factor, _ in pairs]
    return tuple(order), G
