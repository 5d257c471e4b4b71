"""Formulas as parameter-dependent combinations of parameter-free ones, so that data are read once for all parameter values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .evaluation import ColumnEvaluator, compile_expression
from .formula import Formula
from .limits import MAX_TERMS, count_terms
from .window import Window

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FormulaSeparation:
    """Lifted functions written as ``sigma(w; q) = M(q) g(w)``."""

    window: Window  # what ``w`` holds
    parameters: tuple[str, ...]
    basis: tuple[Any, ...]  # SymPy trees of ``g``
    terms: tuple[
        tuple[tuple[int, Any], ...], ...
    ]  # for each function its pairs of a column of ``g`` and the SymPy tree of the coefficient

    @classmethod
    def of(cls, formulas: Sequence[Formula], window: Window, parameters: tuple[str, ...]) -> FormulaSeparation:
        """Separate every formula; one that does not separate raises ConfigError."""
        import sympy as sp

        own = {sp.Symbol(name, real=True) for name in parameters}
        basis: dict[Any, int] = {}
        rows = []
        for formula in formulas:
            row = []
            for coefficient, function in _terms(formula, own):
                row.append((basis.setdefault(function, len(basis)), coefficient))
            rows.append(tuple(row))
        return cls(window, parameters, tuple(basis), tuple(rows))

    @cached_property
    def _columns(self) -> ColumnEvaluator:
        return ColumnEvaluator.of(self.basis)

    def evaluate(self, window: Array, u: Array | None = None) -> Array:
        """Return the parameter-free functions at windows (..., n_window), with the present inputs for input functions; shape (..., n_basis)."""
        out = np.moveaxis(np.empty((len(self.basis), *window.shape[:-1])), 0, -1)  # a function's values side by side
        self._columns.fill(self.window.values(window, u), out)
        return out

    def matrix(self, parameters: Mapping[str, npt.ArrayLike]) -> Array:
        """Return M(q) for parameter values of any common shape, shape (..., p, n_basis)."""
        values = {name: np.asarray(parameters[name], dtype=float) for name in self.parameters}
        shape = np.broadcast_shapes(*(v.shape for v in values.values())) if values else ()
        matrix = np.zeros((*shape, len(self.terms), len(self.basis)))
        for i, row in enumerate(self.terms):
            for j, coefficient in row:
                matrix[..., i, j] += compile_expression(coefficient)(values)
        return matrix


def _terms(formula: Formula, parameters: set[Any]) -> list[tuple[Any, Any]]:
    """Pairs of a coefficient of parameters and a function without them; a formula without parameters is its own function."""
    import sympy as sp

    if not formula.expression.free_symbols & parameters:
        return [(sp.Integer(1), formula.expression)]
    _require_short(formula, formula.expression)
    apart = _split_angles(formula.expression, parameters)
    _require_short(formula, apart)
    pairs = []
    for term in sp.Add.make_args(sp.expand(apart, trig=False)):
        coefficient, function = term.as_independent(
            *(s for s in term.free_symbols if s not in parameters), as_Add=False
        )
        if function.free_symbols & parameters:
            names = tuple(sorted(p.name for p in parameters))
            raise ConfigError(
                f"Lifting function {formula.text!r}: parameters {names} must enter as factors or as phases of sin and cos; rewrite it."
            )
        pairs.append((coefficient, function))
    return pairs


def _require_short(formula: Formula, expression: Any) -> None:
    count = count_terms(expression)
    if count > MAX_TERMS:
        raise ConfigError(
            f"Lifting function {formula.text!r}: multiplied out to separate its parameters it has up to {count:.3g} terms, at most {MAX_TERMS} are kept; "
            "split it into several functions."
        )


def _split_angles(expression: Any, parameters: set[Any]) -> Any:
    """Apply the angle sum formulas to ``sin(data + parameter)`` and ``cos(data + parameter)`` only."""
    import sympy as sp

    def split(argument: Any) -> tuple[Any, Any]:
        own: list[Any] = []
        data: list[Any] = []
        for term in sp.Add.make_args(sp.expand(argument) if argument.free_symbols & parameters else argument):
            (own if term.free_symbols and term.free_symbols <= parameters else data).append(term)
        return sp.Add(*data), sp.Add(*own)

    def sine(argument: Any) -> Any:
        data, own = split(argument)
        return sp.sin(data) * sp.cos(own) + sp.cos(data) * sp.sin(own)

    def cosine(argument: Any) -> Any:
        data, own = split(argument)
        return sp.cos(data) * sp.cos(own) - sp.sin(data) * sp.sin(own)

    return expression.replace(sp.sin, sine).replace(sp.cos, cosine)
