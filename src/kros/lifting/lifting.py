"""The lifting of a population: original states first, lifted functions after them.

Symbols
-------
x         : states, (..., n)
theta(x)  : lifted states [x; sigma(x)], (..., n + p)           (25)
sigma     : lifted functions, formulas of states and per-unit parameters
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DimensionError
from .formula import Evaluator, Formula, compile_expression

Array = npt.NDArray[np.float64]
Parameters = Mapping[str, npt.ArrayLike]


@dataclass(frozen=True)
class Lifting:
    """Lifting functions of the state, with per-unit parameters.

    Parameters
    ----------
    states : tuple of str
    functions : tuple of str
        Formulas of the states and the parameters; empty for a linear model.
    parameters : tuple of str
        Names of quantities that every unit has a value of its own for, such as ``phase``.

    Raises
    ------
    ConfigError
        When a formula cannot be read, is repeated, or depends on no state.
    """

    states: tuple[str, ...]
    functions: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        clash = set(self.states) & set(self.parameters)
        if clash or len(set(self.states)) != len(self.states):
            raise ConfigError(
                f"Lifting: names of states and parameters must differ, found states {self.states} and parameters {self.parameters}; rename {clash}."
            )
        if len(set(self.functions)) != len(self.functions):
            raise ConfigError(f"Lifting: functions {list(self.functions)} repeat one of them; every lifted function must be listed once.")
        for formula in self.formulas:
            if not formula.used & set(self.states):
                raise ConfigError(
                    f"Lifting: {formula.text!r} depends on no state ({', '.join(self.states)}); a constant cannot be lifted, remove it."
                )

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild from the texts in a worker process: compiled formulas do not travel."""
        return Lifting, (self.states, self.functions, self.parameters)

    @cached_property
    def formulas(self) -> tuple[Formula, ...]:
        """Parsed lifted functions."""
        return tuple(Formula(text, self.states + self.parameters) for text in self.functions)

    @property
    def n_states(self) -> int:
        """Number of original states."""
        return len(self.states)

    @property
    def n_lifted(self) -> int:
        """Number of lifted states, the original ones included."""
        return len(self.states) + len(self.functions)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the lifted states."""
        return self.states + self.functions

    def lift(self, x: npt.ArrayLike, parameters: Parameters | None = None) -> Array:
        """Return the lifted states.

        Parameters
        ----------
        x : array_like, shape (..., n)
        parameters : mapping of str to array_like
            Values that broadcast against ``x[..., 0]``.

        Returns
        -------
        ndarray, shape (..., n + p)
        """
        x = np.asarray(x, dtype=float)
        if x.shape[-1] != self.n_states:
            raise DimensionError(f"Lifting: expected {self.n_states} states {self.states} on the last axis, found shape {x.shape}.")
        lifted = np.empty((*x.shape[:-1], self.n_lifted))
        lifted[..., : self.n_states] = x
        self.lift_into(lifted, parameters)
        return lifted

    def lift_into(self, lifted: Array, parameters: Parameters | None = None) -> None:
        """Fill the lifted functions behind states that are already in place, shape (..., n + p)."""
        values = self._values(lifted, parameters)
        for i, formula in enumerate(self.formulas):
            lifted[..., self.n_states + i] = formula.evaluator(values)

    def retract(self, lifted: npt.ArrayLike) -> Array:
        """Return the original states, a slice of the lifted ones."""
        return np.asarray(lifted, dtype=float)[..., : self.n_states]

    def jacobian(self, x: npt.ArrayLike, parameters: Parameters | None = None) -> Array:
        """Return the derivative of the lifted states, shape (..., n + p, n)."""
        x = np.asarray(x, dtype=float)
        jacobian = np.zeros((*x.shape[:-1], self.n_lifted, self.n_states))
        jacobian[..., range(self.n_states), range(self.n_states)] = 1.0
        values = self._values(x, parameters)
        for i, row in enumerate(self._derivatives):
            for j, evaluator in enumerate(row):
                jacobian[..., self.n_states + i, j] = evaluator(values)
        return jacobian

    @cached_property
    def _derivatives(self) -> list[list[Evaluator]]:
        return [[compile_expression(formula.derivative(state)) for state in self.states] for formula in self.formulas]

    def _values(self, x: Array, parameters: Parameters | None) -> dict[str, Array]:
        given = dict(parameters or {})
        missing = [name for name in self.parameters if name not in given]
        if missing:
            raise DimensionError(f"Lifting: parameter values for {missing} are missing, found {sorted(given)}; calibrate the unit first.")
        values = {name: np.asarray(given[name], dtype=float) for name in self.parameters}
        values.update({name: x[..., i] for i, name in enumerate(self.states)})
        return values

    @cached_property
    def separation(self) -> Separation:
        """The functions as parameter-dependent combinations of parameter-free ones."""
        return Separation.of(self)


@dataclass(frozen=True)
class Separation:
    """Lifted functions written as ``sigma(x; q) = M(q) g(x)``.

    For ``sin(100*position + phase)`` the basis is sin and cos of ``100*position``, so a new phase needs no second pass over the data.
    """

    lifting: Lifting
    basis: tuple[Any, ...]
    terms: tuple[tuple[tuple[int, Any], ...], ...]

    @classmethod
    def of(cls, lifting: Lifting) -> Separation:
        """Separate every function of a lifting; a function that does not separate raises ConfigError."""
        import sympy as sp

        parameters = [sp.Symbol(name, real=True) for name in lifting.parameters]
        basis: list[Any] = []
        rows = []
        for formula in lifting.formulas:
            row = []
            for term in sp.Add.make_args(sp.expand(_split_angles(formula.expression, set(parameters)), trig=False)):
                coefficient, function = term.as_independent(*(s for s in term.free_symbols if s not in parameters), as_Add=False)
                if function.free_symbols & set(parameters):
                    raise ConfigError(
                        f"Lifting function {formula.text!r}: parameters {lifting.parameters} must enter as factors or as phases of sin and cos; rewrite it."
                    )
                if function not in basis:
                    basis.append(function)
                row.append((basis.index(function), coefficient))
            rows.append(tuple(row))
        return cls(lifting, tuple(basis), tuple(rows))

    @cached_property
    def _evaluators(self) -> list[Evaluator]:
        return [compile_expression(function) for function in self.basis]

    def evaluate(self, x: Array) -> Array:
        """Return the parameter-free functions at states (..., n), shape (..., n_basis)."""
        values = {name: x[..., i] for i, name in enumerate(self.lifting.states)}
        columns = [np.broadcast_to(evaluator(values), x.shape[:-1]) for evaluator in self._evaluators]
        return np.stack(columns, axis=-1) if columns else np.zeros((*x.shape[:-1], 0))

    def matrix(self, parameters: Parameters) -> Array:
        """Return M(q) for parameter values of any common shape, shape (..., p, n_basis)."""
        values = {name: np.asarray(parameters[name], dtype=float) for name in self.lifting.parameters}
        shape = np.broadcast_shapes(*(v.shape for v in values.values())) if values else ()
        matrix = np.zeros((*shape, len(self.terms), len(self.basis)))
        for i, row in enumerate(self.terms):
            for j, coefficient in row:
                matrix[..., i, j] += compile_expression(coefficient)(values)
        return matrix


def _split_angles(expression: Any, parameters: set[Any]) -> Any:
    """Apply the angle sum formulas to ``sin(data + parameter)`` and ``cos(data + parameter)`` only."""
    import sympy as sp

    def split(argument: Any) -> tuple[Any, Any]:
        own: list[Any] = []
        data: list[Any] = []
        for term in sp.Add.make_args(argument):
            (own if term.free_symbols and term.free_symbols <= parameters else data).append(term)
        return sp.Add(*data), sp.Add(*own)

    def sine(argument: Any) -> Any:
        data, own = split(argument)
        return sp.sin(data) * sp.cos(own) + sp.cos(data) * sp.sin(own)

    def cosine(argument: Any) -> Any:
        data, own = split(argument)
        return sp.cos(data) * sp.cos(own) - sp.sin(data) * sp.sin(own)

    return expression.replace(sp.sin, sine).replace(sp.cos, cosine) if parameters else expression
