"""The lifting functions of a fitted pykoop pipeline as formulas, walked in the order in which the pipeline applies them.

    columns of states and inputs ──► lifting function ──► ... ──► lifted columns, each a SymPy expression of x and u

Numbers stay exact fractions on the way, so that centring and its inverse cancel without a trace.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import ConfigError
from ..lifting.formula import base_and_delay, delayed_name


@dataclass(frozen=True)
class LiftedColumns:
    """Columns behind a lifting function: expressions that a pipeline takes for states, and those it takes for inputs."""

    states: tuple[Any, ...]
    inputs: tuple[Any, ...]


def walk(lifting_functions: Sequence[tuple[str, Any]], columns: LiftedColumns, where: str = "") -> LiftedColumns:
    """Apply fitted lifting functions to symbolic columns.

    Parameters
    ----------
    lifting_functions : sequence of (str, lifting function)
    columns : LiftedColumns
    where : str
        Names of the surrounding pipelines, for messages.

    Returns
    -------
    LiftedColumns

    Raises
    ------
    ConfigError
        A lifting function that has no formula, naming it.
    """
    translators = _translators()
    for name, function in lifting_functions:
        place = f"{where}{name}"
        translate = translators.get(type(function))
        if translate is None:
            raise ConfigError(
                f"from_pykoop: no formula is known for lifting function {place!r} ({type(function).__name__}); known are "
                f"{', '.join(sorted(kind.__name__ for kind in translators))}. Write its functions as formulas of a kros.lifting.Lifting and "
                "identify again."
            )
        columns = translate(function, columns, place)
    return columns


def _translators() -> dict[type, Callable[[Any, LiftedColumns, str], LiftedColumns]]:
    import pykoop

    return {
        pykoop.BilinearInputLiftingFn: _bilinear,
        pykoop.ConstantLiftingFn: _constant,
        pykoop.DelayLiftingFn: _delays,
        pykoop.KernelApproxLiftingFn: _kernel,
        pykoop.KoopmanPipeline: lambda function, columns, place: walk(function.lifting_functions_, columns, f"{place}/"),
        pykoop.PolynomialLiftingFn: _polynomial,
        pykoop.RbfLiftingFn: _radial,
        pykoop.SkLearnLiftingFn: _affine,
        pykoop.SplitPipeline: _split,
    }


def exact(value: Any) -> Any:
    """Return a float as the fraction that it is; fractions stay."""
    import sympy as sp

    return value if isinstance(value, sp.Rational) else sp.Rational(float(value))


def _split(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    states = walk(function.lifting_functions_state_, LiftedColumns(columns.states, ()), f"{place}/").states
    inputs = walk(function.lifting_functions_input_, LiftedColumns((), columns.inputs), f"{place}/").inputs
    return LiftedColumns(states, inputs)


def _polynomial(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    import sympy as sp

    both = (*columns.states, *columns.inputs)
    powers = function.transformer_.powers_[function.transform_order_]
    lifted = [sp.Mul(*(column ** int(p) for column, p in zip(both, row, strict=True))) for row in powers]
    return LiftedColumns(tuple(lifted[: function.n_states_out_]), tuple(lifted[function.n_states_out_ :]))


def _bilinear(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    return LiftedColumns(columns.states, (*columns.inputs, *(x * u for u in columns.inputs for x in columns.states)))


def _constant(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    import sympy as sp

    return LiftedColumns((*columns.states, sp.Integer(1)), columns.inputs)


def _delays(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    def delayed(block: tuple[Any, ...], depth: int) -> tuple[Any, ...]:
        return tuple(_earlier(column, delay) for delay in range(depth + 1) for column in block)

    return LiftedColumns(delayed(columns.states, function.n_delays_state), delayed(columns.inputs, function.n_delays_input))


def _earlier(column: Any, delay: int) -> Any:
    """Return a column as it was `delay` samples before."""
    import sympy as sp

    moved = {}
    for symbol in column.free_symbols:
        name, already = base_and_delay(symbol.name)
        moved[symbol] = sp.Symbol(delayed_name(name, already + delay), real=True)
    return column.xreplace(moved)


def _affine(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    transformer = function.transformer_
    n = len(columns.states) + len(columns.inputs)
    scale, offset = _scale_and_offset(transformer, n, place)
    both = [exact(s) * column + exact(o) for column, s, o in zip((*columns.states, *columns.inputs), scale, offset, strict=True)]
    if function.n_states_out_ != len(columns.states):
        raise ConfigError(f"from_pykoop: lifting function {place!r} changes the number of states; no formula is known for that.")
    return LiftedColumns(tuple(both[: len(columns.states)]), tuple(both[len(columns.states) :]))


def _scale_and_offset(transformer: Any, n: int, place: str) -> tuple[Any, Any]:
    """Return the affine map ``scale * column + offset`` of a fitted scaler; fractions are formed where the scaler divides."""
    import sympy as sp
    from sklearn import preprocessing

    def inverse(scale: Any) -> list[Any]:
        return [sp.Integer(1)] * n if scale is None else [1 / exact(s) for s in scale]

    def centred(scale: list[Any], centre: Any) -> tuple[list[Any], list[Any]]:
        return scale, [sp.Integer(0)] * n if centre is None else [-s * exact(c) for s, c in zip(scale, centre, strict=True)]

    if isinstance(transformer, preprocessing.StandardScaler):
        return centred(inverse(transformer.scale_), transformer.mean_ if transformer.with_mean else None)
    if isinstance(transformer, preprocessing.RobustScaler):
        return centred(inverse(transformer.scale_ if transformer.with_scaling else None), getattr(transformer, "center_", None))
    if isinstance(transformer, preprocessing.MaxAbsScaler) and not getattr(transformer, "clip", False):
        return centred(inverse(transformer.scale_), None)
    if isinstance(transformer, preprocessing.MinMaxScaler) and not transformer.clip:
        return list(transformer.scale_), list(transformer.min_)
    clips = " with clip = True" if getattr(transformer, "clip", False) else ""
    raise ConfigError(
        f"from_pykoop: lifting function {place!r} wraps {type(transformer).__name__}{clips}, which is no affine map that is known; known are "
        "StandardScaler, RobustScaler, MaxAbsScaler and MinMaxScaler without clipping."
    )


def _radial(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    import sympy as sp

    shapes: dict[Any, Callable[[Any], Any]] = {
        "exponential": lambda r: sp.exp(-r),
        "gaussian": lambda r: sp.exp(-(r**2)),
        "multiquadric": lambda r: sp.sqrt(1 + r**2),
        "inverse_quadratic": lambda r: 1 / (1 + r**2),
        "inverse_multiquadric": lambda r: 1 / sp.sqrt(1 + r**2),
        "thin_plate": lambda r: r**2 * sp.log(r),
    }
    shape = shapes.get(function.rbf) if isinstance(function.rbf, str) else None
    if shape is None:
        raise ConfigError(
            f"from_pykoop: lifting function {place!r} has the radial function {function.rbf!r}, which has no formula; known are "
            f"{', '.join(shapes)}."
        )
    both = (*columns.states, *columns.inputs)
    lifted = []
    for centre in function.centers_.centers_:
        distance = sp.sqrt(sp.Add(*((column - exact(c)) ** 2 for column, c in zip(both, centre, strict=True))))
        lifted.append(shape(exact(function.shape) * distance + exact(function.offset_)))
    return _behind(columns, lifted)


def _kernel(function: Any, columns: LiftedColumns, place: str) -> LiftedColumns:
    import pykoop
    import sympy as sp

    kernel = function.kernel_approx_
    if type(kernel) is not pykoop.RandomFourierKernelApprox:
        raise ConfigError(
            f"from_pykoop: lifting function {place!r} wraps {type(kernel).__name__}, which has no formula; known is RandomFourierKernelApprox."
        )
    both = (*columns.states, *columns.inputs)
    weights = np.sqrt(2 * kernel.shape) * kernel.random_weights_
    products = [sp.Add(*(exact(w) * column for column, w in zip(both, weight, strict=True))) for weight in weights.T]
    if kernel.method == "weight_only":
        scale = exact(np.sqrt(1 / kernel.n_components))
        return _behind(columns, [scale * wave(p) for wave in (sp.cos, sp.sin) for p in products])
    scale = exact(np.sqrt(2 / kernel.n_components))
    return _behind(columns, [scale * sp.cos(p + exact(o)) for p, o in zip(products, kernel.random_offsets_, strict=True)])


def _behind(columns: LiftedColumns, lifted: list[Any]) -> LiftedColumns:
    """Append functions to the states where there are no inputs, else to the inputs, as pykoop does."""
    if columns.inputs:
        return LiftedColumns(columns.states, (*columns.inputs, *lifted))
    return LiftedColumns((*columns.states, *lifted), ())


def text(expression: Any) -> str:
    """Return an expression as a formula that `kros.lifting` reads back to the same numbers."""
    import sympy as sp
    from sympy.printing.str import StrPrinter

    class Printer(StrPrinter):
        def _print_Float(self, expr: Any) -> str:  # noqa: N802
            return repr(float(expr))

    fractions = {number: sp.Float(number, 17) for number in expression.atoms(sp.Rational) if not number.is_Integer or abs(number) > 2**53}
    return str(Printer().doprint(expression.xreplace(fractions)))
