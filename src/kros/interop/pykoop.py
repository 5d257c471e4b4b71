"""Fitted pykoop pipelines as models of kros: their lifting as formulas, their Koopman matrix in the coordinates of those.

A pipeline predicts ``z+ = A z + B v`` with lifted states ``z = (affine in x, functions of x, constants)`` and lifted inputs ``v``. A kros
model has the states themselves first, functions after them, and no constant:

    z = T theta(x - x_offset) + c,   v_affine = V (u - u_offset) + d      gives      theta+ = P A T theta + P B [V u; gamma]

with ``P T = I``. Scalers are folded into T and V, their centres into the offsets; a constant term (a constant lifting function, a scaler
behind other functions) disappears in the shift ``c`` that solves ``(I - A) c - B V u = constant``. The result has to predict what pykoop predicts,
at random rows, or it is not returned.
"""

from __future__ import annotations

import keyword
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, DimensionError, IdentificationError, MissingDependencyError
from ..core.lti import StateSpace
from ..data import Population
from ..identify import ModelSet, free_run
from ..lifting import Lifting
from .pykoop_formulas import LiftedColumns, base_and_delay, exact, text, walk

Array = npt.NDArray[np.float64]

_AGREE = 1e-9  # largest difference from pykoop's prediction, relative to the largest prediction of the state
_ROWS = 200
_NOTHING = 1e-12  # relative constant term that is rounding


@dataclass(frozen=True, eq=False)
class AdoptedModel:
    """A fitted pykoop pipeline as a model of kros, in deviations from an offset.

    Parameters
    ----------
    lifting : Lifting
        Of ``x - state_offset``; its names are those of the states.
    inputs : tuple of str
    A : ndarray, shape (n_lifted, n_lifted)
    B : ndarray, shape (n_lifted, n_lifted_inputs)
    state_offset : ndarray, shape (n_states,)
        Zero for pipelines that centre nothing.
    input_offset : ndarray, shape (n_inputs,)
    disagreement : float
        Largest difference from pykoop's one-step prediction at random rows, relative to the largest prediction of the state.
    """

    lifting: Lifting
    inputs: tuple[str, ...]
    A: Array
    B: Array
    state_offset: Array
    input_offset: Array
    disagreement: float = float("nan")

    def predict(self, x: npt.ArrayLike, u: npt.ArrayLike | None = None) -> Array:
        """Predict one step.

        Parameters
        ----------
        x : array_like, shape (..., n_states), or (..., n_samples, n_states) for a lifting with delays
            In the units of the recording, without any offset taken off. With delays: consecutive samples.
        u : array_like, of the same shape but n_inputs, optional
            Not needed by models without inputs.

        Returns
        -------
        ndarray, shape (..., n_states), or (..., n_samples - history, n_states)
            Samples one step later; with delays, the first one follows the first complete history.
        """
        x, n = np.asarray(x, dtype=float), self.lifting.n_states
        theta, inputs = self.lift(x, np.zeros((*x.shape[:-1], 0)) if u is None else u)
        return np.asarray(theta @ self.A[:n].T + inputs @ self.B[:n].T + self.state_offset)

    def lift(self, x: npt.ArrayLike, u: npt.ArrayLike) -> tuple[Array, Array]:
        """Return lifted states and lifted inputs of samples, as in `predict`; both are of deviations from the offsets."""
        xi, mu = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
        if mu.shape != (*xi.shape[:-1], len(self.inputs)):
            raise DimensionError(
                f"AdoptedModel: states of shape {xi.shape} need a row each of the inputs {self.inputs}, found shape {mu.shape}."
            )
        xi, mu, h = xi - self.state_offset, mu - self.input_offset, self.lifting.history
        windows = self.lifting.windows(xi, mu)
        return self.lifting.lift(windows), self.lifting.lift_inputs(mu[..., h:, :] if h else mu, windows)

    def free_run(self, x0: npt.ArrayLike, u: npt.ArrayLike) -> Array:
        """Simulate from first states with recorded inputs, retracted and re-lifted at every step.

        Parameters
        ----------
        x0 : array_like, shape (..., n_states), or (..., history + 1, n_states) for a lifting with delays
        u : array_like, shape (..., n_samples, n_inputs)

        Returns
        -------
        ndarray, shape (..., n_samples, n_states)
            The first samples are `x0`.
        """
        inputs = np.asarray(u, dtype=float) - self.input_offset
        first = np.asarray(x0, dtype=float) - self.state_offset
        batch = inputs.shape[:-2]
        first, inputs = first.reshape(-1, *first.shape[len(batch) :]), inputs.reshape(-1, *inputs.shape[-2:])
        run = free_run(self.A, self.B, self.lifting, {}, first, inputs)
        return np.asarray(run.reshape(*batch, *run.shape[1:]) + self.state_offset)

    def system(self, sample_period_s: float) -> StateSpace:
        """Return the model as a linear system from (lifted) input deviations to lifted states."""
        n, m = self.B.shape
        return StateSpace(self.A, self.B, np.eye(n), np.zeros((n, m)), sample_period_s)


def from_pykoop(pipeline: Any, *, states: Sequence[str] | None = None, inputs: Sequence[str] | None = None, seed: int = 0) -> AdoptedModel:
    """Adopt a fitted `pykoop.KoopmanPipeline`.

    Polynomials, radial basis functions, random Fourier features, delays, products with inputs, constants and affine scalers have formulas,
    also inside a `pykoop.SplitPipeline`. (To read pykoop's array of recordings, see `kros.data.from_pykoop`.)

    Parameters
    ----------
    pipeline : pykoop.KoopmanPipeline
        Fitted.
    states, inputs : sequence of str, optional
        Names for the formulas. Default: those of the frame that the pipeline was fitted to, else ``x0, x1, ...`` and ``u0, u1, ...``.
    seed : int
        Of the rows at which the predictions are compared.

    Returns
    -------
    AdoptedModel

    Raises
    ------
    ConfigError
        A lifting function without a known formula, naming it; names that do not fit.
    IdentificationError
        A pipeline that is not fitted or has no regressor, a constant term that no shift removes, or predictions that differ from pykoop's
        by more than 1e-9 of the largest one.
    MissingDependencyError
        Without pykoop.
    """
    try:
        import pykoop
    except ImportError as error:
        raise MissingDependencyError(
            "from_pykoop needs pykoop, which is not installed; install it (pip install 'kros[pykoop]')."
        ) from error
    if not isinstance(pipeline, pykoop.KoopmanPipeline):
        raise ConfigError(f"from_pykoop: needs a pykoop.KoopmanPipeline, found {type(pipeline).__name__}; put it into a pipeline.")
    if not hasattr(pipeline, "regressor_fit_"):
        raise IdentificationError("from_pykoop: the pipeline is not fitted; call pipeline.fit(X, n_inputs=..., episode_feature=...) first.")
    names, input_names = _names(pipeline, states, inputs)
    model, reading = _translate(pipeline, names, input_names)
    return _verified(model, pipeline, reading, seed)


@dataclass(frozen=True, eq=False)
class _Reading:
    """How a pipeline's lifted states become those of the model, ``theta = P (z[kept] - c)``, and the sizes of its states and inputs."""

    kept: list[int]
    c: Array
    P: Array
    input_size: Array

    def __call__(self, z: Array) -> Array:
        return np.asarray((z[:, self.kept] - self.c) @ self.P.T)

    def state_size(self, n_states: int) -> Array:
        """Return how far a state moves when the pipeline's scaled states move by one."""
        return np.asarray(np.abs(self.P[:n_states, :n_states]).sum(axis=1))


def _names(pipeline: Any, states: Sequence[str] | None, inputs: Sequence[str] | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    n, m = pipeline.n_states_in_, pipeline.n_inputs_in_
    own = getattr(pipeline, "feature_names_in_", None)
    columns = [str(name) for name in own][int(pipeline.episode_feature_) :] if own is not None else []
    x = tuple(states) if states is not None else tuple(columns[:n]) or tuple(f"x{i}" for i in range(n))
    u = tuple(inputs) if inputs is not None else tuple(columns[n:]) or tuple(f"u{i}" for i in range(m))
    bad = [name for name in (*x, *u) if not str(name).isidentifier() or keyword.iskeyword(name) or name == "pi"]
    if (len(x), len(u)) != (n, m) or bad or len({*x, *u}) < n + m or isinstance(states, str) or isinstance(inputs, str):
        raise ConfigError(
            f"from_pykoop: the pipeline has {n} states and {m} inputs, which need different names that a formula can hold, found states {x} and "
            f"inputs {u}; pass states=[...] and inputs=[...]."
        )
    return x, u


def _translate(pipeline: Any, names: tuple[str, ...], input_names: tuple[str, ...]) -> tuple[AdoptedModel, _Reading]:
    """Return the model, and how its lifted states are read from those of the pipeline."""
    import sympy as sp

    x, u = [sp.Symbol(s, real=True) for s in names], [sp.Symbol(s, real=True) for s in input_names]
    lifted = walk(pipeline.lifting_functions_, LiftedColumns(tuple(x), tuple(u)))
    coefficients = np.asarray(pipeline.regressor_.coef_, dtype=float).T
    p, n = len(lifted.states), len(x)
    if coefficients.shape != (p, p + len(lifted.inputs)):
        raise IdentificationError(
            f"from_pykoop: the Koopman matrix has shape {coefficients.shape}, the lifting gives {p} states and {len(lifted.inputs)} inputs; "
            "the regressor does not belong to this pipeline."
        )
    constant = [i for i, column in enumerate(lifted.states) if not column.free_symbols]
    kept = [i for i in range(p) if i not in constant]
    affine = [j for j, column in enumerate(lifted.inputs) if _is_affine(column, u)]
    other = [j for j in range(len(lifted.inputs)) if j not in affine]
    if kept[:n] != list(range(n)) or not all(_is_affine(lifted.states[i], x) for i in range(n)):
        raise IdentificationError("from_pykoop: the first lifted states are not the scaled states, so the state cannot be read off.")
    A, B = coefficients[np.ix_(kept, kept)], coefficients[np.ix_(kept, [p + j for j in affine])]
    S, s0 = _linear_part(lifted.states[:n], x)
    V, d = _linear_part([lifted.inputs[j] for j in affine], u)
    rest = coefficients[np.ix_(kept, constant)] @ np.array([float(lifted.states[i]) for i in constant])
    c, u_offset = _shift(A, B, V, d, rest)
    inverse = S.inv()
    x_offset = list(inverse * (sp.Matrix([exact(value) for value in c[:n]]) - s0)) if n else []
    offsets = dict(zip((*names, *input_names), (*x_offset, *u_offset), strict=True))
    everything = set().union(*(column.free_symbols for column in (*lifted.states, *lifted.inputs)))
    moved = {symbol: symbol + offsets[base_and_delay(symbol.name)[0]] for symbol in everything}
    functions, T, P = _functions([lifted.states[i].xreplace(moved) - exact(c[k]) for k, i in enumerate(kept) if k >= n], S, inverse)
    gamma, G = _input_functions([lifted.inputs[j].xreplace(moved) for j in other], input_names)
    V_float = np.array(V.tolist(), dtype=float).reshape(len(affine), len(u))
    whole = np.concatenate([B @ V_float, coefficients[np.ix_(kept, [p + j for j in other])] @ G], axis=1)
    model = AdoptedModel(
        lifting=Lifting(names, functions, (), input_names if gamma else (), gamma),
        inputs=input_names,
        A=P @ A @ T,
        B=P @ whole,
        state_offset=np.array([float(value) for value in x_offset]),
        input_offset=np.asarray(u_offset, dtype=float),
    )
    return model, _Reading(kept, c, P, 1 / np.abs(V_float).max(axis=0, initial=np.finfo(float).tiny))


def _is_affine(column: Any, symbols: list[Any]) -> bool:
    """Whether a column is affine in these symbols and depends on nothing else."""
    import sympy as sp

    if not column.free_symbols <= set(symbols):
        return False
    return all(not sp.diff(column, symbol).free_symbols for symbol in symbols)


def _linear_part(columns: Sequence[Any], symbols: list[Any]) -> tuple[Any, Any]:
    """Return exact matrices with ``columns = M symbols + m``."""
    import sympy as sp

    M = sp.Matrix(len(columns), len(symbols), lambda i, j: sp.diff(columns[i], symbols[j]))
    zero = dict.fromkeys(symbols, sp.Integer(0))
    return M, sp.Matrix(len(columns), 1, lambda i, j: columns[i].xreplace(zero))


def _shift(A: Array, B: Array, V: Any, d: Any, rest: Array) -> tuple[Array, list[Any]]:
    """Return shifts of lifted states and inputs that leave no constant term.

    The inputs are first moved to where the pipeline's scaled inputs are zero; what is left, if anything, moves states and inputs as
    little as possible.
    """
    n_inputs = V.shape[1]
    V_float = np.array(V.tolist(), dtype=float).reshape(V.shape)
    centre = list((V.T * V).LUsolve(-V.T * d)) if n_inputs else []
    left = d + V * _column(centre) if n_inputs else d
    constant = rest + B @ np.array([float(value) for value in left]) if len(left) else rest
    if not constant.any():
        return np.zeros(len(A)), centre
    matrix = np.concatenate([np.eye(len(A)) - A, -B @ V_float], axis=1)
    solution = np.linalg.lstsq(matrix, constant, rcond=None)[0]
    missing = np.abs(matrix @ solution - constant).max()
    if missing > 1e-10 * np.abs(constant).max():
        if np.abs(constant).max() <= _NOTHING * np.abs(A).sum(axis=1).max():
            return np.zeros(len(A)), centre
        raise IdentificationError(
            f"from_pykoop: the pipeline adds a constant of {np.abs(constant).max():.3g} to the lifted states at every step, and no shift of states "
            f"and inputs removes it ({missing:.3g} is left); leave out the constant lifting function, or scale before lifting."
        )
    return solution[: len(A)], [value + exact(move) for value, move in zip(centre, solution[len(A) :], strict=True)]


def _column(values: list[Any]) -> Any:
    import sympy as sp

    return sp.Matrix(len(values), 1, values)


def _functions(columns: list[Any], S: Any, inverse: Any) -> tuple[tuple[str, ...], Array, Array]:
    """Return formulas without factors or repetitions, and T and P with ``columns = T theta``, ``P T = I``."""
    n = S.shape[0]
    formulas: dict[str, int] = {}
    places = []
    for row, column in enumerate(columns):
        factor, function = column.as_coeff_Mul()
        formula = text(function)
        places.append((formula, float(factor)))
        formulas.setdefault(formula, row)
    order = list(formulas)
    T = np.zeros((n + len(columns), n + len(order)))
    P = np.zeros(T.shape[::-1])
    T[:n, :n], P[:n, :n] = np.array(S.tolist(), dtype=float), np.array(inverse.tolist(), dtype=float)
    for row, (formula, scale) in enumerate(places):
        column_at = n + order.index(formula)
        T[n + row, column_at] = scale
        if formulas[formula] == row:
            P[column_at, n + row] = 1 / scale
    return tuple(order), T, P


def _input_functions(columns: list[Any], inputs: tuple[str, ...]) -> tuple[tuple[str, ...], Array]:
    """Return formulas of the inputs without factors or repetitions, and G with ``columns = G gamma``."""
    pairs = [column.as_coeff_Mul() for column in columns]
    formulas = [text(function) for _, function in pairs]
    order = list(dict.fromkeys(formulas))
    read = [{base_and_delay(symbol.name)[0] for symbol in function.free_symbols} for _, function in pairs]
    idle = [formula for formula, names in zip(formulas, read, strict=True) if not names & set(inputs)]
    if idle:
        raise ConfigError(
            f"from_pykoop: the pipeline takes {idle[0]!r}, which depends on no input, for an input; lift the states by themselves."
        )
    G = np.zeros((len(columns), len(order)))
    G[range(len(columns)), [order.index(formula) for formula in formulas]] = [float(factor) for factor, _ in pairs]
    return tuple(order), G


def _verified(model: AdoptedModel, pipeline: Any, reading: _Reading, seed: int) -> AdoptedModel:
    """Return the model with its disagreement in lifted and in original states, or refuse it."""
    import pykoop

    n, first = model.lifting.n_states, int(pipeline.episode_feature_)
    rng = np.random.default_rng(seed)
    x = model.state_offset + reading.state_size(n) * rng.normal(size=(_ROWS, n))
    u = model.input_offset + reading.input_size * rng.normal(size=(_ROWS, len(model.inputs)))
    rows = np.concatenate([np.zeros((_ROWS, first)), x, u], axis=1)
    with pykoop.config_context(skip_validation=True):  # with it, no pipeline that was fitted to a frame predicts anything (pykoop 2.0.1)
        lifted, predicted = pipeline.transform(rows), np.asarray(pipeline.predict(rows))[:, first:]
    after = pipeline.regressor_.predict(lifted)[:, first:]
    theta, inputs = model.lift(x, u)
    # With delays pykoop's prediction is read from delayed features, which hold the past, in all rows but the last.
    last = slice(-1, None) if model.lifting.history else slice(None)
    together = slice(-min(len(theta), len(lifted)), None)
    pairs = {
        "lifted states": (theta[together], reading(lifted[together, first:])),
        "lifted prediction": ((theta @ model.A.T + inputs @ model.B.T)[together], reading(after[together])),
        "prediction": (model.predict(x, u)[last], predicted[last]),
    }
    differences = {what: _difference(ours, theirs) for what, (ours, theirs) in pairs.items()}
    worst = max(differences, key=lambda what: differences[what])
    if not max(differences.values()) <= _AGREE:  # also where it is not a number
        raise IdentificationError(
            f"from_pykoop: at {_ROWS} random rows the {worst} of the adopted model differ from pykoop's by {differences[worst]:.1e} of the largest, "
            f"allowed are {_AGREE:.0e}; identify the lifting {list(model.lifting.functions)} with kros instead."
        )
    return replace(model, disagreement=differences[worst])


def _difference(ours: Array, theirs: Array) -> float:
    """Return the largest difference relative to the largest value of the column; infinite where it is not a number."""
    largest = np.maximum(np.abs(theirs).max(axis=0), np.finfo(float).tiny)
    difference = float(np.max(np.abs(ours - theirs) / largest, initial=0.0))
    return difference if np.isfinite(difference) else np.inf


def models_from_pykoop(
    pipelines: Mapping[str, Any], population: Population, *, condition: str | None = None, name: str = "pykoop"
) -> ModelSet:
    """Adopt one fitted pipeline for each unit of a population, for uncertainty and synthesis.

    Parameters
    ----------
    pipelines : mapping of str to pykoop.KoopmanPipeline
        By unit, fitted to the channels of the population in their order, all with the same lifting functions and none that centres.
    population : Population
        Gives names, ranges and one-step residuals.
    condition : str, optional
        Default: the first.
    name : str

    Returns
    -------
    ModelSet

    Raises
    ------
    DataError
        A unit that the population does not have in this condition.
    ConfigError
        Pipelines with different lifting functions, or with offsets.
    """
    condition = population.conditions[0] if condition is None else condition
    adopted = {unit: from_pykoop(p, states=population.states, inputs=population.inputs) for unit, p in pipelines.items()}
    missing = [unit for unit in adopted if not population.keys(unit, condition)]
    if missing or not adopted:
        raise DataError(
            f"models_from_pykoop: pipelines of units {list(adopted)}, the population has {list(population.unit_ids)} and no episodes of "
            f"{missing} in condition {condition!r}; name the units as in the population."
        )
    models = list(adopted.values())
    lifting = models[0].lifting
    odd = [unit for unit, model in adopted.items() if model.lifting != lifting]
    centred = [unit for unit, model in adopted.items() if np.any(model.state_offset) or np.any(model.input_offset)]
    if odd or centred:
        raise ConfigError(
            f"models_from_pykoop: models of a population share one lifting, of the channels as they are; units {odd} have other functions than "
            f"{next(iter(adopted))}, units {centred} are centred; scale with MaxAbsScaler (or with_mean=False), or transform the recordings before."
        )
    facts = [_facts(model, population, unit, condition) for unit, model in adopted.items()]
    n = lifting.n_lifted
    peak = np.max([f[0] for f in facts], axis=0)
    return ModelSet(
        name=name,
        condition=condition,
        lifting=lifting,
        channels=population.channels,
        sample_period_s=population.sample_period_s,
        unit_ids=tuple(adopted),
        A=np.stack([model.A for model in models]),
        B=np.stack([model.B for model in models]),
        parameters={},
        residual_covariance=np.stack([f[1] for f in facts]),
        output_scale=peak[:n],
        input_scale=peak[n:],
        status=tuple("ok" if np.abs(np.linalg.eigvals(model.A)).max() < 1 else "unstable" for model in models),
    )


def _facts(model: AdoptedModel, population: Population, unit: str, condition: str) -> tuple[Array, Array]:
    """Return the largest magnitude of every lifted state and input, and the covariance of the one-step residual."""
    peaks, total, count = [], np.zeros_like(model.A), 0
    for key in population.keys(unit, condition):
        lifted, inputs = model.lift(*population.read_parts(key))
        residual = lifted[1:] - lifted[:-1] @ model.A.T - inputs[:-1] @ model.B.T
        peaks.append(np.abs(np.concatenate([lifted, inputs], axis=1)).max(axis=0))
        total += residual.T @ residual
        count += len(residual)
    return np.max(peaks, axis=0), total / max(count, 1)
