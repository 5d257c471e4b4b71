"""Channels of the bank: measurements, functions of them, inputs, and functions of both, as one lifting."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core import Array, ArrayLike, frozen
from ...lifting import Lifting
from ...lifting.formula import Formula
from .settings import EstimatorSettings

Ranges = Mapping[str, tuple[float, float]]  # of measured states and inputs in training, in the recordings' units
Group = tuple[tuple[int, float], ...]  # channels that go on together, a measurement first, and how far each
_QUADRATURE = {"sin": "cos", "cos": "sin"}
CONSTANT = "1"
FAMILIES = ("delays", "linear", "products", "products and random features")  # the first without lags and start


@frozen
class Channels:
    """Signals that filters see: ``v = [y; sigma(y); u; gamma(u, y); 1]``, columns of the lifting."""

    lifting: Lifting
    measured: tuple[int, ...]
    n_inputs: int
    reference: Array  # (q, c): signals that readouts of measured states are relative to
    linear: int  # so many channels are linear: measurements, the user's functions and inputs
    nonlinear: int = 0  # so many after them are functions with lags but no delays
    recent: bool = False  # whether delays alone are filters, without lags and start
    inputs_only: bool = False  # whether they leave measurements out: for gaps
    unbounded: tuple[Group, ...] = ()
    held: tuple[int, ...] = ()  # measurements that readouts of inputs are relative to, for want of a reference

    @property
    def columns(self) -> list[int]:
        """Columns of [theta(x); inputs; functions of inputs] that are channels."""
        n, p, m = self.lifting.n_states, self.lifting.n_lifted, self.n_inputs + len(self.lifting.input_functions)
        if self.inputs_only:
            return [*range(p, p + self.n_inputs), p + m - 1]
        return [*self.measured, *range(n, p), *range(p, p + m)]

    def __len__(self) -> int:
        return len(self.columns)

    def without_measurements(self) -> Channels:
        """Return the inputs and the constant alone; what goes on with an input is relative to it, else to itself."""
        inputs = [self.columns.index(self.lifting.n_lifted + i) for i in range(self.n_inputs)]
        reference, held, groups = np.zeros((len(self.measured), self.n_inputs + 1)), list[int](), list[Group]()
        for group in self.unbounded:
            moving = tuple((inputs.index(channel), far) for channel, far in group if channel in inputs)
            state, step = group[0]
            groups += [moving] if moving else []
            held += [] if moving else [state]
            for channel, far in moving[:1]:
                reference[state, channel] = step / far
        bare = replace(self, linear=self.n_inputs, nonlinear=0, recent=False, inputs_only=True)
        return replace(bare, unbounded=tuple(groups), reference=reference, held=tuple(held))

    @property
    def relative(self) -> tuple[Array, Array]:
        """N (c, c) and E (c, k) of ``w_k = N v_k - E p_k``, p_k the first channels of unbounded groups a sample ago.

        The first channel of a group enters by its changes, the others by their distance from it.
        """
        c, firsts = len(self), [group[0] for group in self.unbounded]
        N, E = np.eye(c), np.zeros((c, len(firsts)))
        for k, ((first, step), group) in enumerate(zip(firsts, self.unbounded, strict=True)):
            E[first, k] = 1.0
            for other, far in group[1:]:
                N[other, first] = -far / step
        return N, E

    def filtered(self, v: Array) -> Array:
        """Return the signals w that filters see, of channels v along the first axis."""
        if not self.unbounded:
            return v
        N, E = self.relative
        before = np.concatenate([v[:1], v[:-1]])
        return v @ N.T - before @ E @ E.T

    def signals(self, y: Array, u: Array, parameters: Mapping[str, ArrayLike]) -> Array:
        """Return the channels of measurements (..., q) and inputs (..., m), shape (..., channels)."""
        x = np.zeros((*y.shape[:-1], self.lifting.n_states))
        x[..., list(self.measured)] = y
        lifted = self.lifting.lift(x, parameters), self.lifting.lift_inputs(u, x, parameters)
        return np.concatenate(lifted, axis=-1)[..., self.columns]


def channels_of(
    lifting: Lifting,
    measured: Sequence[int],
    inputs: Sequence[str],
    family: str,
    ranges: Ranges,
    settings: EstimatorSettings,
) -> Channels:
    """Return the channels of a family, without functions that read states which are not measured."""
    names, nonlinear = [*(lifting.states[i] for i in measured), *inputs], list[str]()
    known = {*names[: len(measured)], *lifting.parameters}
    functions = [f.text for f in lifting.formulas if f.used <= known]
    functions += [text for f in lifting.formulas if f.used <= known and (text := quadrature(f, lifting.parameters))]
    of_inputs = [f.text for f in lifting.input_formulas if f.used and f.used <= known | set(inputs)]  # no constants
    functions = list(dict.fromkeys(functions))
    linear = len(measured) + len(functions) + len(inputs) + len(of_inputs)
    groups = [(name, *together) for name, together in settings.unbounded.items()]
    free = {name for group in groups for name in group}
    y, u = ([name for name in some if name not in free] for some in (names[: len(measured)], inputs))
    if family in FAMILIES[2:]:
        nonlinear += products(y, u, ranges, settings.beyond)
    if family in FAMILIES[3:]:
        nonlinear += random_features(y, u, ranges, settings)
    bare = replace(
        lifting, functions=tuple(functions), inputs=tuple(inputs), input_functions=(*of_inputs, *nonlinear, CONSTANT)
    )
    place = {name: i if i < len(measured) else i + len(functions) for i, name in enumerate(names)}
    sizes = dict(zip(names, lifting.sizes_of(names), strict=True))
    unbounded = tuple(tuple((place[name], 1 / sizes[name]) for name in group) for group in groups)
    count = linear + len(nonlinear) + 1
    reference, recent = np.eye(len(measured), count), family == FAMILIES[0]
    return Channels(bare, tuple(measured), len(inputs), reference, linear, len(nonlinear), recent, unbounded=unbounded)


def quadrature(formula: Formula, calibrated: Sequence[str]) -> str:
    """Return the cosine that belongs to a sine of a calibrated angle, or the sine of a cosine."""
    outer, bracket, angle = formula.text.strip().partition("(")
    if outer in _QUADRATURE and formula.used & set(calibrated) and angle.endswith(")"):
        return _QUADRATURE[outer] + bracket + angle
    return ""


def clipped(name: str, ranges: Ranges, beyond: float) -> str:
    """Return the formula of a quantity that is cut off beyond its range in training."""
    low, high = ranges[name]
    low, high = low - beyond * (high - low), high + beyond * (high - low)
    return f"((abs({name} - {low!r}) - abs({name} - {high!r}) + {low + high!r})/2)".replace("- -", "+ ")


def without_limits(text: str) -> str:
    """Return a formula with every quantity that `clipped` wrote by its name alone, for messages."""
    return re.sub(r"\(\(abs\((\w+)[^)]*\) - abs\([^)]*\)[^)]*\)/2\)", r"\1", text)


def products(measured: Sequence[str], inputs: Sequence[str], ranges: Ranges, beyond: float) -> list[str]:
    """Return u|u|, u^2 and y u of every input and measurement."""
    y, u = ([clipped(name, ranges, beyond) for name in names] for names in (measured, inputs))
    return [f"{a}*abs({a})" for a in u] + [f"{a}**2" for a in u] + [f"{a}*{b}" for a in u for b in y]


def random_features(
    measured: Sequence[str], inputs: Sequence[str], ranges: Ranges, settings: EstimatorSettings
) -> list[str]:
    """Return hyperbolic tangents of random combinations of measurements and inputs, of size one."""
    rng = np.random.default_rng(settings.seed)
    names = [*measured, *inputs]
    if not inputs:
        return []
    size = np.array([max(abs(low), abs(high)) / np.sqrt(3) for low, high in (ranges[name] for name in names)])
    size[size == 0] = 1.0
    weights, offsets = (
        rng.standard_normal((settings.features, len(names))) / size,
        rng.standard_normal(settings.features),
    )
    variables = [clipped(name, ranges, settings.beyond) for name in names]
    return [
        "tanh(" + " + ".join(f"{w!r}*{x}" for w, x in zip(row.tolist(), variables, strict=True)) + f" + {b!r})"
        for row, b in zip(weights, offsets.tolist(), strict=True)
    ]
