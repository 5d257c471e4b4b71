"""What a lifting reads of recordings: earlier values, and functions that hold no parameter of a unit.

A window is what a lifting is evaluated on: the present states, then the earlier values that its formulas name,

    w_k = [x_k, q_{k-1}, ..., q_{k-d}, ...]        for every delayed quantity q, a state or an input, to its depth d

At the next sample each earlier value takes the place behind it; the shift is exact, no model is asked. Formulas are
combinations of parameter-free ones, ``sigma(w; q) = M(q) g(w)``, so that data are read once for all values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..core import ConfigError, DataError, DimensionError
from ..core.arrays import Array, Index, Parameters
from .formula import MAX_TERMS, Formula, Names, base_and_delay, count_terms, delayed_name
from .program import Program


@dataclass(frozen=True)
class Window:
    """Layout of a window."""

    states: Names
    inputs: Names
    depths: tuple[tuple[str, int], ...] = ()  # deepest delay of every delayed quantity

    @classmethod
    def of(cls, states: Names, inputs: Names, used: Iterable[str]) -> Window:
        """Collect the delays from the names that formulas use."""
        depths: dict[str, int] = {}
        for base, delay in map(base_and_delay, used):
            depths[base] = max(depths.get(base, 0), delay)
        return cls(states, inputs, tuple((q, depths[q]) for q in states + inputs if depths.get(q)))

    @property
    def history(self) -> int:
        """Deepest delay in samples."""
        return max((depth for _, depth in self.depths), default=0)

    @cached_property
    def delayed(self) -> tuple[tuple[str, int], ...]:
        """The quantity behind every earlier value, and how many samples before it is meant."""
        return tuple((q, d) for q, depth in self.depths for d in range(1, depth + 1))

    @cached_property
    def earlier(self) -> Names:
        """Names of the earlier values, in the order of the window."""
        return tuple(delayed_name(q, d) for q, d in self.delayed)

    @property
    def quantities(self) -> tuple[tuple[str, int], ...]:
        """The quantity behind every entry, and how many samples before it is meant."""
        return (*((state, 0) for state in self.states), *self.delayed)

    @property
    def names(self) -> Names:
        """Names of all entries."""
        return self.states + self.earlier

    @cached_property
    def shift(self) -> Index:
        """Entry of ``[window, inputs]`` that every earlier value has at the next sample."""
        return self._entries([delayed_name(q, d - 1) for q, d in self.delayed])

    @cached_property
    def present(self) -> Index:
        """Entry of ``[window, inputs]`` of the quantity that every earlier value is one of."""
        return self._entries([q for q, _ in self.delayed])

    def _entries(self, names: Sequence[str]) -> Index:
        entries = (*self.names, *self.inputs)
        return np.array([entries.index(name) for name in names], dtype=np.intp)

    def advance(self, window: Array, u: Array) -> Array:
        """Return the earlier values of the next sample, shape (..., n_earlier), from a window and its inputs."""
        return np.concatenate([window, u], axis=-1)[..., self.shift]

    def hold(self, x: Array, u: Array) -> Array:
        """Return earlier values that all equal the present ones, shape (..., n_earlier)."""
        padding = np.zeros((*x.shape[:-1], len(self.earlier)))
        return np.concatenate([x, padding, u], axis=-1)[..., self.present]

    def require(self, n_samples: int, beyond: int = 0) -> None:
        """Refuse a recording that is shorter than the history and `beyond` samples after its first window."""
        needed = self.history + 1 + beyond
        if n_samples < needed:
            delays = "".join(f" for the delay of {d} in {q!r}" for q, d in self.depths if d == self.history)
            problem = f"needs at least {needed} samples{delays}, found {n_samples}"
            raise DataError(f"Lifting a recording: {problem}; leave the episode out or use shorter delays.")

    def require_inputs(self, u: Array) -> None:
        """Refuse inputs that are not those the formulas were written for."""
        if self.inputs and u.shape[-1] != len(self.inputs):
            raise DimensionError(f"Lifting: expected {len(self.inputs)} inputs {self.inputs} last, found {u.shape}.")

    def columns(self, window: Array, u: Array | None = None) -> dict[str, Array]:
        """Return the columns by name, present inputs among them where they are given."""
        columns = {name: window[..., i] for i, name in enumerate(self.names)}
        return columns if u is None else columns | {name: u[..., i] for i, name in enumerate(self.inputs)}


@dataclass(frozen=True)
class FormulaSeparation:
    """Lifted functions written as ``sigma(w; q) = M(q) g(w)``."""

    window: Window  # what ``w`` holds
    parameters: Names
    basis: tuple[Any, ...]  # SymPy trees of ``g``
    terms: tuple[tuple[tuple[int, Any], ...], ...]  # of each function: columns of ``g`` and coefficients' trees

    @classmethod
    def of(cls, formulas: Sequence[Formula], window: Window, parameters: Names) -> FormulaSeparation:
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
        self._program.fill(out, self.window.columns(window, u))
        return out

    def matrix(self, parameters: Parameters) -> Array:
        """Return M(q) for parameter values of any common shape, shape (..., p, n_basis)."""
        values = {name: np.asarray(parameters[name], dtype=float) for name in self.parameters}
        shape = np.broadcast_shapes(*(v.shape for v in values.values()))
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
        coefficient, function = term.as_independent(*(term.free_symbols - parameters), as_Add=False)
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

    def summed(function: Any, other: Any, sign: int) -> Callable[[Any], Any]:
        def split(argument: Any) -> Any:
            terms = sp.Add.make_args(sp.expand(argument) if argument.free_symbols & parameters else argument)
            shifts = [term for term in terms if term.free_symbols and term.free_symbols <= parameters]
            data, phase = sp.Add(*(term for term in terms if term not in shifts)), sp.Add(*shifts)
            return function(data) * sp.cos(phase) + sign * other(data) * sp.sin(phase)

        return split

    return expression.replace(sp.sin, summed(sp.sin, sp.cos, 1)).replace(sp.cos, summed(sp.cos, sp.sin, -1))
