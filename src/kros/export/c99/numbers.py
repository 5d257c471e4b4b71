"""What the C source of an observer consists of: sizes, matrices, limits and formulas, as the templates want them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...core import AGREED, Array, ConfigError, Record, frozen
from ...lifting.program import Precision, c_code
from ...motor_drive import AngleLoad
from ...observer import Observer, recorded_channel, recorded_factors
from ...observer.filter_bank import OLDEST
from ...observer.monitor import LARGEST, QUIET, RECOVERY
from ...observer.runtime import bounds
from ...observer.screen import BEYOND, LONGEST, Screen
from ...observer.tracking import MOST, PhaseLockedLoop, measurement_sizes
from ..text import plain, plain_names, require_identifier
from .origin import RULE, OriginShift, find_shift

TOLERANCE = {"double": 1e-9, "float": 1e-3}  # of golden vectors
DOUBLE, SINGLE = Precision(), Precision("float")


@frozen
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

    observer: Observer
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
        loop = None if track is None else PhaseLockedLoop(observer, track, 1)
        shift = find_shift(observer) if precision == "float" else None
        return cls(observer, name, Precision(precision), shift, loop, load)

    def rendered(self, package: str, files: Mapping[str, str], more: Record) -> dict[str, str]:
        """Return the text of every file, by its name and that of its template in a package."""
        from jinja2 import Environment, PackageLoader, StrictUndefined

        environment = Environment(loader=PackageLoader(package), undefined=StrictUndefined, keep_trailing_newline=True)
        environment.filters |= {
            "row": partial(row, precision=self.precision),
            "sums": self.sums,
            "code": self.code,
            "literal": self.precision.literal,
            "double": DOUBLE.literal,
            "wide": row,
            "plain": plain,
        }
        context = self.context() | more
        return {file: environment.get_template(f"{name}.jinja").render(context) for file, name in files.items()}

    def context(self) -> Record:
        """Return what the templates name: the observer and its parts, names, sizes, and matrices."""
        o, loop, factors = self.observer, self.loop, self.factors()
        lifting, K = o.lifting, o.controller
        low, high = bounds(o.guard, lifting.n_states, K.n_states)
        model = np.hstack([o.A, o.B])[: lifting.n_states]
        correction = o.into[: lifting.n_states] @ np.hstack([K.C, K.D])
        controller = np.hstack([K.A, K.B])
        moving = () if self.shift is None else self.shift.states[: len(o.recorded)]
        return {
            "o": o,
            "lifting": lifting,
            "precision": self.precision,
            "single": self.precision.type == "float",
            "monitor": o.monitor,
            "bank": o.bank,
            "bridge": self.bridge(),
            "shift": self.shift,
            "shift_others": [i for i in np.flatnonzero(moving).tolist() if i != o.measured[0]],
            "load": self.load_torque(),
            "tracked": None if loop is None else self.tracked(loop),
            "name": self.name,
            "NAME": self.name.upper(),
            "states": plain_names(o.recorded),
            "measured": plain_names(o.outputs),
            "inputs": plain_names(o.inputs),
            "parameters": lifting.parameters,
            "signals": self.signals(),
            "factors": factors,
            "x_factor": self.literals([1 / factors[s] for s in o.recorded]),
            "y_factor": self.literals([factors[s] for s in o.outputs]),
            "u_factor": self.literals([factors[s] for s in o.inputs]),
            "at": list(o.measured),
            "n": lifting.n_states,
            "recorded": len(o.recorded),
            "q": len(o.measured),
            "m": len(o.inputs),
            "functions": len(lifting.functions),
            "order": K.n_states,
            "delay": o.runtime.delay,
            "start": o.runtime.first(lifting.n_states),
            "history": len(lifting.window.earlier),
            "guard": np.clip([low, high], -self.precision.largest, self.precision.largest),
            "bounds": self.bounds(),
            "gate": () if o.bank is None else np.minimum(o.bank.gate, self.precision.largest),
            "rest": () if o.bank is None else np.minimum(o.bank.rest, self.precision.largest),
            "OLDEST": OLDEST,
            "quiet": () if o.bank is None else AGREED * o.bank.error_sizes(o.measured) ** 2,
            "rule": {"beyond": BEYOND, "recovery": RECOVERY, "largest": LARGEST, "quiet": QUIET},
            "longest": Screen.of(o).longest,
            "LONGEST": LONGEST,
            "far": RULE.far,
            "model": self.sums(model),
            "correction": self.sums(correction),
            "controller": self.sums(controller),
            "operations": sum(map(np.count_nonzero, (model, correction, controller))),
        }

    def factors(self) -> dict[str, float]:
        """Return by what recordings are multiplied, by name."""
        names = (*self.observer.recorded, *self.observer.inputs)
        factors = recorded_factors(self.observer, list(map(self.channel, names)))
        return dict(zip(names, factors.tolist(), strict=True))

    def channel(self, name: str) -> str:
        """Return the channel that has the unit of a signal: of a load torque its current, else the signal."""
        return self.load.current if self.load is not None and name == self.load.load else name

    def signals(self) -> list[dict[str, str]]:
        """Return name, unit of measure and note of every channel, as they stand in the recordings."""
        o = self.observer
        own = {name: recorded_channel(o, self.channel(name)) for name in (*o.recorded, *o.inputs)}
        return [
            {"name": plain(name), "unit": plain(c.unit or "not declared"), "note": " ".join(map(plain, c.note.split()))}
            for name, c in own.items()
        ]

    def literals(self, factors: Sequence[float]) -> list[str]:
        """Return the literals of factors in double precision; none where all are one."""
        return [] if all(factor == 1 for factor in factors) else row(np.array(factors))

    def bridge(self) -> Record | None:
        """Return how recorded states and filters follow from filters, and by what slopes from every measurement."""
        o = self.observer
        if o.bank is None:
            return None
        n, m, end = o.lifting.n_states, len(o.inputs), len(o.recorded) + o.bank.filters
        A, functions, slopes = o.A[:end], np.hstack([o.A[:, n:], o.B[:, m:]])[:end], list[Record]()
        for i, output in zip(o.measured, o.outputs, strict=True):
            trees = [f.derivative(output) for f in (*o.lifting.formulas, *o.lifting.input_formulas)]
            moving = [j for j, tree in enumerate(trees) if tree != 0]
            rows = np.column_stack([A[:, i], functions[:, moving]])
            values = [f"({self.code(trees[j])})" for j in moving]
            slopes.append(
                {
                    "functions": values,
                    "rows": [[(j, DOUBLE.literal(v)) for j, v in enumerate(row) if v] for row in rows.tolist()],
                }
            )
        filters = A[:, len(o.recorded) : end]
        row, column = np.nonzero(filters)
        q, size = len(o.measured), len(o.measured) + o.bank.filters
        return {
            "operations": 3 * size * (len(row) + q * end) + 2 * q * size**2,
            "entries": filters[row, column],
            "columns": column.tolist(),
            "rows": np.searchsorted(row, range(end + 1)).tolist(),
            "slopes": slopes,
        }

    def tracked(self, loop: PhaseLockedLoop) -> Record:
        """Return the parts of a phase-locked loop: the linear part, and slopes of functions."""
        o, name, n, states = self.observer, loop.name, self.observer.lifting.n_states, self.observer.lifting.states
        slopes, given = [], () if o.bank is None else o.measured  # measurements take the place of estimates
        uncorrected = o.A.copy()  # the model with the direct correction, lifted functions held
        uncorrected[:, list(o.measured)] -= o.into @ o.controller.D
        uncorrected[:, list(given)] = 0.0
        for f in o.lifting.formulas:
            by_state = {j: f.derivative(s) for j, s in enumerate(states) if s in f.used and j not in given}
            lines = [(j, f"({self.code(d)})") for j, d in by_state.items() if d != 0]
            slopes.append({"by_value": f"({self.code(f.derivative(name))})", "by_state": lines})
        return {
            "name": name,
            "place": o.lifting.parameters.index(name),
            "slopes": slopes,
            "reads_states": any("w[" in str(row) for row in slopes),
            "model": self.sums(uncorrected[:n]),
            "correction": self.sums((o.into @ o.controller.C)[:n]),
            "shares": row(measurement_sizes(o) ** -2, self.precision),
            "settle_s": o.sample_period_s / loop.forget,
            "forget": self.precision.literal(loop.forget),
            "most": self.precision.literal(MOST),
        }

    def load_torque(self) -> Record | None:
        """Return the numbers of `AngleLoad`."""
        if self.load is None:
            return None
        level, load, current = self.load.level, self.load.load, self.load.current
        return {
            "level": level,
            "limited": np.isfinite(level.limit),
            "load_name": plain(load),
            "current_name": plain(current),
            "factor": self.factor(current),
            "angle_factor": self.factor(self.observer.outputs[0]),
            "load": self.observer.recorded.index(load),
            "current": self.observer.recorded.index(current),
        }

    def factor(self, name: str) -> str | None:
        """Return the literal of a channel's factor; None where it is one."""
        return next(iter(self.literals([self.factors()[name]])), None)

    def symbol(self, name: str) -> str:
        """Return the C expression of a quantity of a formula: window w, parameters p, inputs u."""
        lifting = self.observer.lifting
        places = {"w": lifting.window.names, "p": lifting.parameters, "u": self.observer.inputs}
        return next(f"{array}[{names.index(name)}]" for array, names in places.items() if name in names)

    def sums(self, values: Array) -> list[list[tuple[int, str]]]:
        """Return what is multiplied by which entry of a column, row by row; zeros are left out."""
        return [[(int(j), self.precision.literal(float(row[j]))) for j in np.flatnonzero(row)] for row in values]

    def code(self, expression: Any) -> str:
        """Return the C expression of a formula's tree."""
        return c_code(expression, self.symbol, self.precision)

    def bounds(self) -> list[dict[str, str]]:
        """Return the bounds of measurements and inputs in double precision, and those of good samples in single."""
        screen = Screen.of(self.observer)
        texts = {name: row(getattr(screen, name)) for name in ("lower", "upper", "least", "most")}
        texts["low"] = row(np.maximum(screen.lower, screen.least), SINGLE)
        texts["high"] = row(np.minimum(screen.upper, screen.most), SINGLE)
        return [dict(zip(texts, row, strict=True)) for row in zip(*texts.values(), strict=True)]


def row(values: Array, precision: Precision = DOUBLE) -> list[Any]:
    """Return the literals of numbers, row by row; infinity as the largest number."""
    if values.ndim > 1:
        return [row(one, precision) for one in values]
    return [precision.literal(v) for v in np.clip(values, -precision.largest, precision.largest).tolist()]
