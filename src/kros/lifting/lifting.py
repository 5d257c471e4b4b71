"""The lifting of a population: original states, then lifted functions; inputs may have functions, too.

Symbols
-------
x         : states, (..., n)
w         : window, the states and the earlier values that formulas name, (..., n_window); x itself without delays
theta(w)  : lifted states [x; sigma(w)], (..., n + p)           (25)
sigma     : lifted functions, formulas of states, earlier values and per-unit parameters
u         : recorded inputs, (..., m)
gamma     : input functions, formulas of inputs and of what sigma reads; lifted inputs [u; gamma(u, w)]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ..core import Array, ArrayLike, ConfigError, DimensionError, Parameters
from .formula import Formula, Names, base_and_delay, require_text
from .intervals import Box, slope_bounds_of
from .program import Program
from .window import FormulaSeparation, Window


@dataclass(frozen=True)
class Lifting:
    """Lifting functions of the state, with per-unit parameters, delays and functions of the inputs.

    Raises
    ------
    ConfigError
        When a formula cannot be read, is repeated, or depends on no state (an input function: on no input).

    Examples
    --------
    >>> gearbox = Lifting(("position", "velocity"), ("sin(100*position + phase)",), ("phase",))
    >>> gearbox.lift([[0.0, 3.0]], {"phase": 0.0}).tolist()
    [[0.0, 3.0, 0.0]]
    """

    states: Names
    functions: Names = ()  # formulas of states, of earlier values such as ``voltage[-2]``, and of parameters
    parameters: Names = ()  # quantities whose value differs from unit to unit, such as ``phase``
    inputs: Names = ()  # recorded inputs; needed where formulas name one, otherwise any number passes through
    input_functions: Names = ()  # further inputs of the model, such as ``current*voltage``; ``1`` is affine
    sizes: tuple[tuple[str, float], ...] = ()  # of states, inputs and functions by name, see `in_sizes`; else one

    def __post_init__(self) -> None:
        """Refuse what cannot be lifted."""
        everything = (*self.states, *self.parameters, *self.inputs)
        if clash := {name for name in everything if everything.count(name) > 1}:
            raise ConfigError(f"Lifting: names of states, parameters and inputs must differ; rename {clash}.")
        _refuse_repeated(self.formulas, self.states)
        _refuse_repeated(self.input_formulas, self.inputs)
        for formula in self.formulas:
            if present := sorted(formula.used & set(self.inputs)):
                problem = f"{formula.text!r} reads the present input {', '.join(present)}"
                raise ConfigError(f"Lifting: {problem}; make it an input function, or read {present[0]}[-1].")
            if not formula.used - set(self.parameters):
                problem = f"depends on no state ({', '.join(self.states)}); a constant cannot be lifted"
                raise ConfigError(f"Lifting: {formula.text!r} {problem}, remove it.")
        for formula in self.input_formulas:
            if formula.used and not {base_and_delay(name)[0] for name in formula.used} & set(self.inputs):
                problem = f"depends on no input ({', '.join(self.inputs) or 'none are named'})"
                raise ConfigError(f"Lifting: the input function {formula.text!r} {problem}; make it a function.")

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild from the texts in a worker process: programs do not travel."""
        return Lifting, tuple(getattr(self, f.name) for f in fields(self))

    def in_sizes(self, sizes: Mapping[str, float]) -> Lifting:
        """Return the lifting for channels and functions divided by sizes; formulas stay as they are written.

        Sizes are by name of a state or an input, or text of a function; what is not named keeps its unit.

        >>> metres = Lifting(("x",), ("x**2",))
        >>> kilometres = metres.in_sizes({"x": 1000.0, "x**2": 1e6})
        >>> metres.lift([[3000.0]]).tolist(), kilometres.lift([[3.0]]).tolist()
        ([[3000.0, 9000000.0]], [[3.0, 9.0]])
        """
        return replace(self, sizes=tuple((name, float(size)) for name, size in sizes.items()))

    def sizes_of(self, names: Sequence[str]) -> Array:
        """Return the sizes of states, inputs or functions, shape (len(names),)."""
        known = dict(self.sizes)
        return np.array([known.get(name, 1.0) for name in names], dtype=float)

    @cached_property
    def formulas(self) -> tuple[Formula, ...]:
        """Parsed lifted functions."""
        return self._parsed(self.functions)

    @cached_property
    def input_formulas(self) -> tuple[Formula, ...]:
        """Parsed input functions."""
        return self._parsed(self.input_functions)

    def _parsed(self, texts: Names) -> tuple[Formula, ...]:
        names, delayed, known = self.states + self.parameters + self.inputs, self.states + self.inputs, dict(self.sizes)
        sizes = tuple((name, known[name]) for name in delayed if name in known)
        return tuple(Formula(text, names, delayed, sizes, known.get(require_text(text), 1.0)) for text in texts)

    @cached_property
    def window(self) -> Window:
        """Which earlier values the formulas read."""
        used = [name for f in self.formulas + self.input_formulas for name in f.used]
        return Window.of(self.states, self.inputs, used)

    @property
    def history(self) -> int:
        """Deepest delay in samples; 0 for functions of the present state alone."""
        return self.window.history

    @property
    def n_states(self) -> int:
        """Number of original states."""
        return len(self.states)

    @property
    def n_lifted(self) -> int:
        """Number of lifted states, the original ones included."""
        return len(self.states) + len(self.functions)

    @property
    def names(self) -> Names:
        """Names of the lifted states."""
        return self.states + self.functions

    def lift(self, x: ArrayLike, parameters: Parameters | None = None) -> Array:
        """Return the lifted states (..., n + p) of windows (..., n_window): of states alone where there are no delays.

        Values of parameters broadcast against ``x[..., 0]``.
        """
        x = self._windows(x)
        lifted = np.empty((*x.shape[:-1], self.n_lifted))
        lifted[..., : self.n_states] = x[..., : self.n_states]
        self._fill(lifted[..., self.n_states :], self._programs[0], parameters, x)
        return lifted

    def lift_inputs(self, u: ArrayLike, window: ArrayLike, parameters: Parameters | None = None) -> Array:
        """Return the inputs (..., m) with the input functions behind them, (..., m + r), on windows (..., n_window)."""
        u = np.asarray(u, dtype=float)
        self.window.require_inputs(u)
        if not self.input_functions:
            return u
        window = self._windows(window)
        out = np.concatenate([u, np.empty((*u.shape[:-1], len(self.input_functions)))], axis=-1)
        self._fill(out[..., u.shape[-1] :], self._programs[1], parameters, window, u)
        return out

    def windows(self, x: Array, u: Array) -> Array:
        """Return the windows of a recording, shape (..., n_samples - history, n_window), from sample `history` on."""
        window = self.window
        window.require_inputs(u)
        if not window.depths:
            return x
        window.require(x.shape[-2])
        columns, names = np.concatenate([x, u], axis=-1), (*self.states, *self.inputs)
        h, end = window.history, x.shape[-2]
        earlier = [columns[..., h - d : end - d, names.index(q)] for q, d in window.delayed]
        return np.concatenate([x[..., h:, :], np.stack(earlier, axis=-1)], axis=-1)

    def parameter_values(self, parameters: Parameters | None = None) -> dict[str, Array]:
        """Return the values of all parameters, refusing to go on where one is missing."""
        given = parameters or {}
        if missing := [name for name in self.parameters if name not in given]:
            problem = f"parameter values for {missing} are missing, found {sorted(given)}"
            raise DimensionError(f"Lifting: {problem}; calibrate the unit first.")
        return {name: np.asarray(given[name], dtype=float) for name in self.parameters}

    def slopes(
        self,
        x: ArrayLike,
        parameters: Parameters | None = None,
        names: Names | None = None,
        u: ArrayLike | None = None,
    ) -> Array:
        """Return the derivative of the lifted functions, with inputs that of the input functions, on windows.

        The shape is (..., p, n), by the entries of the window or by the names of some of them and of parameters.
        """
        x, names, inputs = self._windows(x), names or self.window.names, None if u is None else np.asarray(u)
        formulas = self.formulas if inputs is None else self.input_formulas
        slopes = np.empty((*x.shape[:-1], len(formulas) * len(names)))
        self._fill(slopes, _derivatives(formulas, names), parameters, x, inputs)
        return slopes.reshape(*x.shape[:-1], len(formulas), len(names))

    def slope_bounds(self, box: Box | None = None) -> tuple[Array, Array]:
        """Return bounds of the slopes of every lifted function by every entry of the window over an operating box.

        The bounds (p, n_window) hold between any two points of the box, and are infinite where a slope is, or where a
        function jumps. Ranges are numbers or pairs (lower, upper) by name; what is not named may be anything.

        >>> Lifting(("position",), ("sin(100*position + phase)",), ("phase",)).slope_bounds()[1].round(6)
        array([[100.]])
        """
        return slope_bounds_of(self.formulas, self.window.names, box or {})

    @cached_property
    def separation(self) -> FormulaSeparation:
        """The functions as parameter-dependent combinations of parameter-free ones."""
        return FormulaSeparation.of(self.formulas, self.window, self.parameters)

    @cached_property
    def input_separation(self) -> FormulaSeparation:
        """The same for the input functions."""
        return FormulaSeparation.of(self.input_formulas, self.window, self.parameters)

    @cached_property
    def _programs(self) -> tuple[Program, Program]:
        """Programs of the lifted functions and of the input functions."""
        functions, gamma = ([formula.expression for formula in f] for f in (self.formulas, self.input_formulas))
        return Program.of(functions), Program.of(gamma)

    def _windows(self, x: ArrayLike) -> Array:
        x, names = np.asarray(x, dtype=float), self.window.names
        if x.shape[-1:] != (len(names),):
            raise DimensionError(f"Lifting: expected {len(names)} entries {names} last, found shape {x.shape}.")
        return x

    def _fill(
        self, out: Array, program: Program, parameters: Parameters | None, window: Array, u: Array | None = None
    ) -> None:
        """Write the values of a program along the last axis."""
        program.fill(out, self.parameter_values(parameters) | self.window.columns(window, u))


@lru_cache
def _derivatives(formulas: tuple[Formula, ...], names: Names) -> Program:
    """Return the derivatives of formulas by quantities."""
    return Program.of([formula.derivative(name) for formula in formulas for name in names])


def _refuse_repeated(formulas: tuple[Formula, ...], originals: Names) -> None:
    import sympy as sp

    names, known = {sp.Symbol(name, real=True): name for name in originals}, dict[Any, str]()
    for formula in formulas:
        text = formula.text
        if original := names.get(formula.written):
            raise ConfigError(f"Lifting: {text!r} is {original!r} itself, which is there already; remove it.")
        if other := known.get(formula.written):
            raise ConfigError(
                f"Lifting: functions repeat one of them, {text!r} is {other!r}; list every function once."
            )
        known[formula.written] = text
