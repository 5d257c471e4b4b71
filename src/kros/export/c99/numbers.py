"""What the C source of an observer consists of: sizes, matrices, limits and formulas, as the templates want them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError
from ...lifting.program import Precision, c_code
from ...motor_drive import AngleLoad
from ...observer import Observer
from ...observer.guard import bounds
from ...observer.monitor import LARGEST, QUIET, RECOVERY, poisson_interval
from ...observer.origin import FAR, OriginShift
from ...observer.recorded import recorded_channel, recorded_factors
from ...observer.samples import LONGEST
from ...observer.screen import Bounds, Screen
from ...observer.tracking import MOST, PhaseLockedLoop, measurement_sizes
from ..text import plain, plain_names
from .realise import Realised

Array = npt.NDArray[np.float64]
FAR_SINGLE = 8  # periods from the origin, as far as single precision goes


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


@dataclass(frozen=True, eq=False)
class Source:
    """An observer in the terms of its C source."""

    realised: Realised
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
        if load is not None and (missing := [s for s in (load.load, load.current) if s not in observer.recorded]):
            raise ConfigError(
                f"Export: load torque needs the states {', '.join(missing)}, found {', '.join(observer.recorded)}."
            )
        realised = Realised.of(observer)
        observer = realised.observer
        loop = None if track is None else PhaseLockedLoop(observer, track, 1)
        return cls(realised, name, Precision(precision), realised.shift, loop, load)

    @property
    def observer(self) -> Observer:
        """The observer in the coordinates in which it is computed."""
        return self.realised.observer

    def context(self) -> dict[str, Any]:
        """Return everything that the templates name."""
        o, lifting, run = self.observer, self.observer.lifting, self.observer.runtime
        n, q, m, K = lifting.n_states, len(o.measured), len(o.inputs), o.controller
        functions, widened = lifting.n_lifted - n, o.B.shape[1]
        screen = Screen.of(o)
        limited = run.limited
        x_names, y_names = (*o.recorded,), [lifting.states[i] for i in o.measured]
        factors = self.factors()
        return {
            "name": self.name,
            "NAME": self.name.upper(),
            "observer_name": plain(o.name),
            "real": self.precision.type,
            "suffix": self.precision.suffix,
            "zero": self.precision.literal(0.0),
            "single": self.precision.type == "float",
            "states": plain_names(o.recorded),
            "measured": plain_names(lifting.states[i] for i in o.measured),
            "inputs": plain_names(o.inputs),
            "parameters": lifting.parameters,
            "signals": self.signals(),
            "x_factor": self.literals([1 / factors[s] for s in x_names]),
            "y_factor": self.literals([factors[s] for s in y_names]),
            "u_factor": self.literals([factors[s] for s in o.inputs]),
            "at": o.measured,
            "n": n,
            "recorded": len(o.recorded),
            "q": q,
            "m": m,
            "functions": functions,
            "widened": widened,
            "order": K.n_states,
            "delay": run.delay,
            "longest": LONGEST,
            "limited": limited,
            "clips_estimate": run.lower is not None or run.upper is not None,
            "relifts": run.relift,
            "clips_correction": run.correction is not None,
            "width": o.into.shape[1],
            "history": len(lifting.window.earlier),
            "window_shift": [int(i) for i in lifting.window.shift] if lifting.history else [],
            "window_present": [int(i) for i in lifting.window.present] if lifting.history else [],
            "model": self.sums(self.realised.model),
            "less": [
                (j, i, None if factor == 1 else self.precision.literal(factor)) for j, i, factor in self.realised.less
            ],
            "correction": self.sums(np.hstack([K.C, K.D]) if limited else o.into[:n] @ np.hstack([K.C, K.D])),
            "into": self.sums(o.into[:n]) if limited else [],
            "controller": self.sums(np.hstack([K.A, K.B])),
            "filter_gain": self.sums(o.filter_gain),
            "monitor": self.monitor(),
            "guard": self.guard(),
            "lower": self.numbers(_filled(run.lower, n, -np.inf), wide=True),
            "upper": self.numbers(_filled(run.upper, n, np.inf), wide=True),
            "largest": self.numbers(_filled(run.correction, o.into.shape[1], np.inf)),
            "y_bounds": self.bounds(screen.measured),
            "u_bounds": self.bounds(screen.inputs),
            "default_parameters": self.numbers(np.array([o.parameters.get(p, 0.0) for p in lifting.parameters])),
            "sigma": [c_code(f.expression, self.symbol, self.precision) for f in lifting.formulas],
            "gamma": [c_code(f.expression, self.symbol, self.precision) for f in lifting.input_formulas],
            "bank": self.bank(),
            "tracked": self.tracked(),
            "load": self.load_torque(),
            "shift": self.shift,
            "shift_states": None if self.shift is None else self.wide(self.shift.states),
            "shift_whole": None if self.shift is None else self.wide(self.shift.whole),
            "shift_rest": None if self.shift is None else self.wide(self.shift.rest),
            "relative_inputs": self.relative_inputs(),
            "shift_others": []
            if self.shift is None
            else [i for i in range(len(o.recorded)) if i != o.measured[0] and self.shift.states[i] != 0],
            "far": None
            if self.shift is None
            else self.precision.literal((FAR_SINGLE if self.precision.type == "float" else FAR) * self.shift.period),
            "period": None if self.shift is None else Precision().literal(self.shift.period),
            "recorded_period": None if self.shift is None else abs(self.shift.period / factors[y_names[0]]),
            "sample_period_s": Precision().literal(o.sample_period_s),
        }

    def factors(self) -> dict[str, float]:
        """Return by what the recordings of channels are multiplied, by name; a load torque is in the unit of its current."""
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
        return [] if all(factor == 1 for factor in factors) else [Precision().literal(factor) for factor in factors]

    def relative_inputs(self) -> list[str]:
        """Return the inputs relative to the origin: an exact difference first, and nothing that is zero, which a processor without doubles pays for."""
        if self.shift is None:
            return []
        found = []
        for j, (whole, rest) in enumerate(zip(self.shift.whole, self.shift.rest, strict=True)):
            text = f"s->held[{j}]"
            if whole != 0:
                text = f"{text} - {'s->origin' if whole == 1 else f'({Precision().literal(float(whole))} * s->origin)'}"
            found.append(text if rest == 0 else f"({text}) - s->moved_u[{j}]")
        return found

    def tracked(self) -> dict[str, Any] | None:
        """Return what a phase-locked loop consists of: the observer's linear part, and slopes of lifted functions by states and parameter."""
        if self.loop is None:
            return None
        o, K, name, write = self.observer, self.observer.controller, self.loop.name, self.precision.literal
        n, states = o.lifting.n_states, o.lifting.states

        def code(slope: Any) -> str:
            return f"({c_code(slope, self.symbol, self.precision)})"

        slopes = []
        for f in o.lifting.formulas:
            given = () if o.bank is None else o.measured  # measurements take the place of estimates
            by_state = {j: f.derivative(s) for j, s in enumerate(states) if s in f.used and j not in given}
            slopes.append(
                {
                    "by_value": code(f.derivative(name)),
                    "by_state": [(j, code(d)) for j, d in by_state.items() if d != 0],
                }
            )
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
            "one": write(1.0),
            "most": write(MOST),
        }

    def load_torque(self) -> dict[str, Any] | None:
        """Return the numbers of `AngleLoad`, in double precision: it sums up for as long as it runs."""
        if self.load is None:
            return None
        level, places, write = self.load.level, self.observer.recorded, Precision().literal
        return {
            "load_name": plain(self.load.load),
            "current_name": plain(self.load.current),
            "factor": self.load_factor(self.load.current),
            "angle_factor": self.load_factor(self.observer.lifting.states[self.observer.measured[0]]),
            "load": places.index(self.load.load),
            "current": places.index(self.load.current),
            "pole": write(level.pole),
            "period": write(level.sample_period_s),
            "trust": write(0.5 * level.settling_s),
            "limit": write(level.limit) if np.isfinite(level.limit) else None,
            "trusted": write(level.trusted * level.limit) if np.isfinite(level.limit) else None,
        }

    def load_factor(self, name: str) -> str | None:
        """Return the literal of a channel's factor; None where it is one."""
        return next(iter(self.literals(recorded_factors(self.observer, [name]).tolist())), None)

    def bank(self) -> dict[str, Any] | None:
        """Return what a filter bank starts with and does in gaps; None where the observer is none."""
        own, o = self.observer.bank, self.observer
        if own is None:
            return None
        first = len(o.recorded)
        z = slice(first, first + own.filters)
        return {
            "filters": own.filters,
            "first": first,
            "fallback": o.lifting.n_states - first,
            "start": self.sums(self.realised.start),
            "forget": self.numbers(own.forget),
            "reach": self.numbers(own.reach),
            "half": self.numbers(own.half),
            "recovery": self.numbers(own.recovery),
            "ramp": self.sums(o.A[z, z]),
            "into": self.matrix(self.realised.into),
            "one": self.precision.literal(1.0),
            "hidden": [f"{int(i not in o.measured)}u" for i in range(first)],
        }

    def monitor(self) -> dict[str, Any] | None:
        """Return what the monitor computes with; None where the observer has none."""
        own = self.observer.monitor
        if own is None:
            return None
        return {
            "bands": len(own.filters),
            "filters": self.matrix(own.filters),
            "inverse_size": self.numbers(1 / own.size),
            "inverse_limit": self.matrix(1 / own.limits),
            "weights": own.weights.astype(int).tolist(),
            "quiet": self.precision.literal(QUIET),
            "forget": self.precision.literal(own.forget),
            "first": self.precision.literal(max(own.first, own.forget)),
            "largest": self.precision.literal(LARGEST),
            "one": self.precision.literal(1.0),
            "settle": own.settle,
            "conditions": [plain(c) for c in own.bounds],
            "products": [self.precision.literal(own.product(c)) for c in (None, *own.bounds)],
            "recovery": RECOVERY,
            "rates": {
                "percent": f"{100 * own.false_alarm_rate:g}",
                "units": own.units,
                "alarms": own.alarms,
                "hours": f"{own.hours:.3g}",
            }
            | {"interval": [f"{v / own.hours:.3g}" for v in poisson_interval(own.alarms)] if own.hours else None},
        }

    def guard(self) -> dict[str, Any]:
        """Return the bounds of states and of the correction, and how long a start takes."""
        own, n, order = self.observer.guard, self.observer.lifting.n_states, self.observer.controller.n_states
        most = np.finfo(np.float32 if self.precision.type == "float" else np.float64).max
        low, high = (np.clip(side, -most, most) for side in bounds(own, n, order))
        wide = {"lower": self.wide(low[:n]), "upper": self.wide(high[:n])}
        return wide | {"correction": self.numbers(high[n:]), "settle": 0 if own is None else own.settle}

    def symbol(self, name: str) -> str:
        """Return what stands for a quantity of a formula in C: window w, parameters p, inputs u."""
        lifting = self.observer.lifting
        for names, array in ((lifting.window.names, "w"), (lifting.parameters, "p"), (self.observer.inputs, "u")):
            if name in names:
                return f"{array}[{names.index(name)}]"
        raise KeyError(name)

    def sums(self, values: Array) -> list[list[tuple[int, str]]]:
        """Return what is multiplied by which entry of a column, row by row; zeros are left out."""
        return [[(int(j), self.precision.literal(float(row[j]))) for j in np.flatnonzero(row)] for row in values]

    def matrix(self, values: Array) -> list[list[str]]:
        """Return the literals of a matrix, row by row."""
        return [[self.precision.literal(float(v)) for v in row] for row in values]

    def numbers(self, values: Array, wide: bool = False) -> list[str]:
        """Return the literals of a row; infinity as the largest number."""
        precision = Precision() if wide and self.precision.type == "float" else self.precision
        most = float(np.finfo(np.float32 if precision.type == "float" else np.float64).max)
        return [precision.literal(float(np.clip(v, -most, most))) for v in values]

    def wide(self, values: Array) -> list[str]:
        """Return literals in double precision."""
        return [Precision().literal(float(v)) for v in values]

    def bounds(self, bounds: Bounds) -> list[dict[str, str]]:
        """Return the bounds of every channel in double precision, and in single precision between which a sample is good as it is."""
        rows, most = zip(bounds.lower, bounds.upper, bounds.least, bounds.most, strict=True), float(np.finfo(float).max)
        found = []
        for row in rows:
            lower, upper, least, furthest = (float(np.clip(v, -most, most)) for v in row)
            wide = {"lower": lower, "upper": upper, "least": least, "most": furthest}
            inner = np.clip([max(lower, least), min(upper, furthest)], *(np.finfo(np.float32).max * np.array([-1, 1])))
            texts = {name: Precision().literal(v) for name, v in wide.items()}
            found.append(
                texts | {name: Precision("float").literal(v) for name, v in zip(("low", "high"), inner, strict=True)}
            )
        return found


def _uncorrected(observer: Observer) -> Array:
    """Return what the model and the direct correction make of a change of the estimate, the lifted functions held; shape (n_lifted, n_lifted)."""
    A = observer.A.copy()
    A[:, list(observer.measured)] -= observer.into @ observer.controller.D
    if observer.bank is not None:
        A[:, list(observer.measured)] = 0.0
    return A


def _filled(values: Array | None, count: int, otherwise: float) -> Array:
    return np.full(count, otherwise) if values is None else values
