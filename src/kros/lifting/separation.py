"""Formulas as combinations of parameter-free ones, so that data are read once for all parameter values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .formula import MAX_TERMS, Formula, count_terms
from .program import Program
from .window import Window

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FormulaSeparation:
    """Lifted functions written as ``sigma(w; q) = M(q) g(w)``."""

    window: Window  # what ``w`` holds
    parameters: tuple[str, ...]
    basis: tuple[Any, ...]  # SymPy trees of ``g``
    terms: tuple[tuple[tuple[int, Any], ...], ...]  # of each function: columns of ``g`` and coefficients' trees

    @classmethod
    def of(cls, formulas: Sequence[Formula], window: Window, parameters: tuple[str, ...]) -> FormulaSeparation:
        """Separate every formula; one that does not separate raises ConfigError."""
        import sympy as sp

        symbols = {sp.Symbol(name, real=True) for name in parameters}
        basis: dict[Any, int] = {}
        pairs = [_terms(formula, symbols) for formula in formulas]
        rows = tuple(tuple((basis.setdefault(g, len(basis)), coefficient) for coefficient, g in row) for row in pairs)
        return cls(window, parameters, tuple(basis), rows)

    @cached_property
    def _program(self) -> Program:
        return Program.of(self.basis)

    def evaluate(self, window: Array, u: Array | None = None) -> Array:
        """Return the parameter-free functions at windows (..., n_window), and inputs if given; (..., n_basis)."""
        out = np.moveaxis(np.empty((len(self.basis), *window.shape[:-1])), 0, -1)  # a function's values side by side
        self._program.fill(out, self.window.values(window, u))
        return out

    def matrix(self, parameters: Mapping[str, npt.ArrayLike]) -> Array:
        """Return M(q) for parameter values of any common shape, shape (..., p, n_basis)."""
        values = {name: np.asarray(parameters[name], dtype=float) for name in self.parameters}
        shape = np.broadcast_shapes(*(v.shape for v in values.values())) if values else ()
        matrix = np.zeros((*shape, len(self.terms), len(self.basis)))
        for i, row in enumerate(self.terms):
            for j, coefficient in row:
                matrix[..., i, j] += Program.of([coefficient]).run(values)[0]
        return matrix


def _terms(formula: Formula, parameters: set[Any]) -> list[tuple[Any, Any]]:
    """Pairs of a coefficient of parameters and a function without them."""
    import sympy as sp

    if not formula.expression.free_symbols & parameters:
        return [(sp.Integer(1), formula.expression)]
    _require_short(formula, formula.expression)
    apart = _split_angles(formula.expression, parameters)
    _require_short(formula, apart)
    pairs = []
    for term in sp.Add.make_args(sp.expand(apart, trig=False)):
        data = (symbol for symbol in term.free_symbols if symbol not in parameters)
        coefficient, function = term.as_independent(*data, as_Add=False)
        if function.free_symbols & parameters:
            problem = f"parameters {tuple(sorted(p.name for p in parameters))} must enter as factors or as phases"
            raise ConfigError(f"Lifting function {formula.text!r}: {problem} of sin and cos.")
        pairs.append((coefficient, function))
    return pairs


def _require_short(formula: Formula, expression: Any) -> None:
    count = count_terms(expression)
    if count > MAX_TERMS:
        problem = f"multiplied out to separate its parameters it has up to {count:.3g} terms"
        raise ConfigError(f"Lifting function {formula.text!r}: {problem}, at most {MAX_TERMS} are kept.")


def _split_angles(expression: Any, parameters: set[Any]) -> Any:
    """Apply the angle sum formulas to ``sin(data + parameter)`` and ``cos(data + parameter)`` only."""
    import sympy as sp

    def split(argument: Any) -> tuple[Any, Any]:
        terms = sp.Add.make_args(sp.expand(argument) if argument.free_symbols & parameters else argument)
        phase = [term for term in terms if term.free_symbols and term.free_symbols <= parameters]
        return sp.Add(*(term for term in terms if term not in phase)), sp.Add(*phase)

    def sine(argument: Any) -> Any:
        data, phase = split(argument)
        return sp.sin(data) * sp.cos(phase) + sp.cos(data) * sp.sin(phase)

    def cosine(argument: Any) -> Any:
        data, phase = split(argument)
        return sp.cos(data) * sp.cos(phase) - sp.sin(data) * sp.sin(phase)

    return expression.replace(sp.sin, sine).replace(sp.cos, cosine)
