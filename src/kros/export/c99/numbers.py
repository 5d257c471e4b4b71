"""What the C source of an observer consists of: sizes, matrices, limits and formulas, as the templates want them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.arrays import Array, frozen
from ...core.errors import ConfigError
from ...lifting.program import Precision, c_code
from ...motor_drive import AngleLoad
from ...observer import Observer
from ...observer.filter_bank import longest_age
from ...observer.monitor import LARGEST, QUIET, RECOVERY
from ...observer.runtime import bounds
from ...observer.screen import BEYOND, LONGEST, Screen
from ...observer.tracking import MOST, PhaseLockedLoop, measurement_sizes
from ...observer.units import recorded_channel, recorded_factors
from ..text import plain, plain_names, require_identifier
from .origin import OriginShift, find_shift
from .realise import RULE, realised

Named = dict[str, Any]  # what templates name

TOLERANCE = {"double": 1e-9, "float": 1e-3}  # of golden vectors
DOUBLE, SINGLE = Precision(), Precision("float")


@dataclass(frozen=True)
class LoadOutput:
    """Load torque and total current with their levels as outputs (`AngleLoad`), of an observer that estimates a load.

    Parameters
    ----------
    level : AngleLoad
    load, current : str
        Names of the observer's states.

    Examples
    --------
    >>> from kros.export import LoadOutput
    >>> from kros.motor_drive import AngleLoad
    >>> LoadOutput(AngleLoad(level_s=2.0, sample_period_s=0.001), current="current").load
    'load'
    """

    level: AngleLoad
    load: str = "load"
    current: str = "current"


@frozen
class Source:
    """An observer in the terms of its C source."""

    observer: Observer  # in the coordinates in which it is computed
    name: str
    precision: Precision
    shift: OriginShift | None
    loop: PhaseLockedLoop | None = None
    load: LoadOutput | None = None

    @classmethod
    def of(
        cls, observer: Observer, name: str, precision: str, track: str | None = None, load: LoadOutput | None = None
    ) -> Source:
        """Look at an observer; refuse what it cannot give."""
        require_identifier(name)
        for parameter in observer.lifting.parameters:
            require_identifier(parameter, "parameter")
        if precision not in TOLERANCE:
            raise ConfigError(f"Export: precision should be {' or '.join(TOLERANCE)}, found {precision!r}.")
        if load is not None and (missing := [s for s in (load.load, load.current) if s not in observer.recorded]):
            raise ConfigError(f"Export: load torque needs {', '.join(missing)}, found {', '.join(observer.recorded)}.")
        observer = realised(observer)
        loop = None if track is None else PhaseLockedLoop(observer, track, 1)
        shift = find_shift(observer) if precision == "float" else None
        return cls(observer, name, Precision(precision), shift, loop, load)

    def context(self) -> Named:
        """Return everything that the templates name."""
        lifting = self.observer.lifting
        parts = {"monitor": self.monitor(), "guard": self.guard(), "bank": self.bank(), "tracked": self.tracked()}
        parts |= self.layout() | self.linear() | self.limits() | self.origin()
        return parts | {
            "sigma": [self.code(f.expression) for f in lifting.formulas],
            "gamma": [self.code(f.expression) for f in lifting.input_formulas],
            "sigma_uses_parameters": any(set(f.used) & set(lifting.parameters) for f in lifting.formulas),
            "load": self.load_torque(),
            "sample_period_s": DOUBLE.literal(self.observer.sample_period_s),
        }

    def layout(self) -> Named:
        """Return names, units of measure, and numbers of states, channels and samples."""
        o, factors, measured, lifting = self.observer, self.factors(), self.observer.outputs, self.observer.lifting
        return {
            "name": self.name,
            "NAME": self.name.upper(),
            "observer_name": plain(o.name),
            "real": self.precision.type,
            "suffix": self.precision.suffix,
            "zero": self.precision.literal(0.0),
            "one": self.precision.literal(1.0),
            "single": self.precision.type == "float",
            "states": plain_names(o.recorded),
            "measured": plain_names(measured),
            "inputs": plain_names(o.inputs),
            "parameters": lifting.parameters,
            "signals": self.signals(),
            "x_factor": self.literals([1 / factors[s] for s in o.recorded]),
            **{f"{k}_factor": self.literals([factors[s] for s in v]) for k, v in (("y", measured), ("u", o.inputs))},
            "at": o.measured,
            "n": lifting.n_states,
            "recorded": len(o.recorded),
            "q": len(measured),
            "m": len(o.inputs),
            "functions": lifting.n_lifted - lifting.n_states,
            "widened": o.B.shape[1],
            "order": o.controller.n_states,
            "delay": o.runtime.delay,
            "longest": LONGEST,
            "history": len(lifting.window.earlier),
            "window_shift": lifting.window.shift.tolist(),
            "window_present": lifting.window.present.tolist(),
        }

    def linear(self) -> Named:
        """Return the model and the correction, zeros left out."""
        o, K, n = self.observer, self.observer.controller, self.observer.lifting.n_states
        parts = np.hstack([o.A, o.B])[:n], o.into[:n] @ np.hstack([K.C, K.D]), np.hstack([K.A, K.B])
        sums = dict(zip(("model", "correction", "controller"), map(self.sums, parts), strict=True))
        return sums | {
            "operations": sum(np.count_nonzero(part) for part in parts),
            "filter_gain": self.sums(o.filter_gain),
        }

    def limits(self) -> Named:
        """Return limits and default parameters."""
        o, q, bounds, sides = self.observer, len(self.observer.measured), self.bounds(), self.observer.runtime.sides
        largest = None if o.seen is None else o.seen.measured * BEYOND / np.abs(recorded_factors(o, o.outputs))
        return {
            "clips_estimate": bool(o.runtime.limits()),
            **dict(zip(("lower", "upper"), map(row, sides(o.lifting.n_states)), strict=True)),
            "largest_angle": None if largest is None else ", ".join(f"{v:.6g}" for v in largest),
            "y_bounds": bounds[:q],
            "u_bounds": bounds[q:],
            "default_parameters": self.row(np.array([o.parameters.get(p, 0.0) for p in o.lifting.parameters])),
        }

    def origin(self) -> Named:
        """Return how the origin moves; nothing where it cannot."""
        shift, o = self.shift, self.observer
        if shift is None:
            return {"shift": None, "relative_inputs": [], "shift_others": []}
        return {
            "shift": shift,
            "shift_states": row(shift.states),
            "shift_whole": row(shift.whole),
            "shift_rest": row(shift.rest),
            "relative_inputs": [self.relative_input(j) for j in range(len(o.inputs))],
            "shift_others": [i for i in range(len(o.recorded)) if i != o.measured[0] and shift.states[i] != 0],
            "far": self.precision.literal(RULE.far * shift.period),
            "period": DOUBLE.literal(shift.period),
            "recorded_period": abs(shift.period / self.factors()[o.outputs[0]]),
        }

    def relative_input(self, j: int) -> str:
        """Return an input relative to the origin: an exact difference first, and nothing that is zero."""
        assert self.shift is not None
        whole, text = float(self.shift.whole[j]), f"s->held[{j}]"
        if whole != 0:
            text += " - s->origin" if whole == 1 else f" - ({DOUBLE.literal(whole)} * s->origin)"
        return text if self.shift.rest[j] == 0 else f"({text}) - s->moved_u[{j}]"

    def factors(self) -> dict[str, float]:
        """Return by what recordings are multiplied, by name; a load torque has the unit of its current."""
        names = (*self.observer.recorded, *self.observer.inputs)
        found = dict(zip(names, recorded_factors(self.observer, names).tolist(), strict=True))
        return found if self.load is None else found | {self.load.load: found[self.load.current]}

    def signals(self) -> list[dict[str, str]]:
        """Return name, unit of measure and note of every channel, as they stand in the recordings."""
        o = self.observer
        load = {} if self.load is None else {self.load.load: recorded_channel(o, self.load.current)}
        own = {name: load.get(name, recorded_channel(o, name)) for name in (*o.recorded, *o.inputs)}
        return [
            {"name": plain(name), "unit": plain(c.unit or "not declared"), "note": " ".join(map(plain, c.note.split()))}
            for name, c in own.items()
        ]

    def literals(self, factors: Sequence[float]) -> list[str]:
        """Return the literals of factors in double precision; none where all are one."""
        return [] if all(factor == 1 for factor in factors) else row(np.array(factors))

    def tracked(self) -> Named | None:
        """Return the parts of a phase-locked loop: the linear part, and slopes of functions."""
        if self.loop is None:
            return None
        o, K, name, write = self.observer, self.observer.controller, self.loop.name, self.precision.literal
        n, states = o.lifting.n_states, o.lifting.states

        slopes, given = [], () if o.bank is None else o.measured  # measurements take the place of estimates
        for f in o.lifting.formulas:
            by_state = {j: f.derivative(s) for j, s in enumerate(states) if s in f.used and j not in given}
            lines = [(j, f"({self.code(d)})") for j, d in by_state.items() if d != 0]
            slopes.append({"by_value": f"({self.code(f.derivative(name))})", "by_state": lines})
        return {
            "name": name,
            "place": o.lifting.parameters.index(name),
            "slopes": slopes,
            "reads_states": any("w[" in str(row) for row in slopes),
            "model": self.sums(_uncorrected(o)[:n]),
            "correction": self.sums((o.into @ K.C)[:n]),
            "shares": [write(float(v) ** -2) for v in measurement_sizes(o)],
            "settle_s": f"{o.sample_period_s / self.loop.forget:g}",
            "forget": write(self.loop.forget),
            "most": write(MOST),
        }

    def load_torque(self) -> Named | None:
        """Return the numbers of `AngleLoad`, in double precision: it sums up without end."""
        if self.load is None:
            return None
        level, places, write = self.load.level, self.observer.recorded, DOUBLE.literal
        return {
            "load_name": plain(self.load.load),
            "current_name": plain(self.load.current),
            "factor": self.factor(self.load.current),
            "angle_factor": self.factor(self.observer.outputs[0]),
            "load": places.index(self.load.load),
            "current": places.index(self.load.current),
            "pole": write(level.pole),
            "period": write(level.sample_period_s),
            "trust": write(0.5 * level.settling_s),
            "limit": write(level.limit) if np.isfinite(level.limit) else None,
            "trusted": write(level.trusted * level.limit) if np.isfinite(level.limit) else None,
        }

    def factor(self, name: str) -> str | None:
        """Return the literal of a channel's factor; None where it is one."""
        return next(iter(self.literals(recorded_factors(self.observer, [name]).tolist())), None)

    def bank(self) -> Named | None:
        """Return what a filter bank starts with and does in gaps; None where the observer is none."""
        own, o, first = self.observer.bank, self.observer, len(self.observer.recorded)
        if own is None:
            return None
        z = slice(first, first + own.filters)
        return {
            "filters": own.filters,
            "first": first,
            "fallback": o.lifting.n_states - first,
            "start": self.sums(own.start),
            **{name: self.row(getattr(own, name)) for name in ("forget", "reach", "half", "recovery")},
            "longest": self.row(longest_age(own.half)),
            "ramp": self.sums(o.A[z, z]),
            "into": self.row(o.A[z][:, list(o.measured)]),
            "hidden": [f"{int(i not in o.measured)}u" for i in range(first)],
        }

    def monitor(self) -> Named | None:
        """Return what the monitor computes with; None where the observer has none."""
        own = self.observer.monitor
        if own is None:
            return None
        numbers = {"quiet": QUIET, "forget": own.forget, "first": max(own.first, own.forget), "largest": LARGEST}
        return {
            "bands": len(own.filters),
            "filters": self.row(own.filters),
            "inverse_size": self.row(1 / own.size),
            "inverse_limit": self.row(1 / own.limits),
            "weights": own.weights.astype(int).tolist(),
            **{name: self.precision.literal(value) for name, value in numbers.items()},
            "settle": own.settle,
            "recovery": RECOVERY,
            "percent": f"{100 * own.false_alarm_rate:g}",
            "units": own.units,
        }

    def guard(self) -> Named:
        """Return the bounds of states and of the correction, and how long a start takes."""
        own, n, most = self.observer.guard, self.observer.lifting.n_states, self.precision.largest
        low, high = np.clip(bounds(own, n, self.observer.controller.n_states), -most, most)
        sides = {"lower": row(low[:n]), "upper": row(high[:n]), "settle": own.settle if own else 0}
        return sides | {"correction": self.row(high[n:])}

    def symbol(self, name: str) -> str:
        """Return the C expression of a quantity of a formula: window w, parameters p, inputs u."""
        lifting = self.observer.lifting
        places = {"w": lifting.window.names, "p": lifting.parameters, "u": self.observer.inputs}
        return next(f"{array}[{names.index(name)}]" for array, names in places.items() if name in names)

    def sums(self, values: Array) -> list[list[tuple[int, str]]]:
        """Return what is multiplied by which entry of a column, row by row; zeros are left out."""
        return [[(int(j), self.precision.literal(float(row[j]))) for j in np.flatnonzero(row)] for row in values]

    def row(self, values: Array) -> list[Any]:
        """Return the literals of numbers, row by row."""
        return row(values, self.precision)

    def code(self, expression: Any) -> str:
        """Return the C expression of a formula's tree."""
        return c_code(expression, self.symbol, self.precision)

    def bounds(self) -> list[dict[str, str]]:
        """Return the bounds of measurements and inputs in double precision, and those of good samples in single."""
        screen = Screen.of(self.observer)
        wide = {name: getattr(screen, name) for name in ("lower", "upper", "least", "most")}
        inner = {"low": np.maximum(screen.lower, screen.least), "high": np.minimum(screen.upper, screen.most)}
        texts = {name: row(values) for name, values in wide.items()}
        texts |= {name: row(values, SINGLE) for name, values in inner.items()}
        return [dict(zip(texts, row, strict=True)) for row in zip(*texts.values(), strict=True)]


def row(values: Array, precision: Precision = DOUBLE) -> list[Any]:
    """Return the literals of numbers, row by row; infinity as the largest number."""
    if values.ndim > 1:
        return [row(one, precision) for one in values]
    return [precision.literal(v) for v in np.clip(values, -precision.largest, precision.largest).tolist()]


def _uncorrected(observer: Observer) -> Array:
    """Return the model with the direct correction, lifted functions held, shape (n_lifted, n_lifted)."""
    A = observer.A.copy()
    A[:, list(observer.measured)] -= observer.into @ observer.controller.D
    if observer.bank is not None:
        A[:, list(observer.measured)] = 0.0
    return A
