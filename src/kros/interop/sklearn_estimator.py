"""Identification of one Koopman model as a scikit-learn regressor, for pipelines, grid searches and cross-validation.

One model is fitted to all rows, of whatever unit. A batch of units with a model each, and the uncertainty between them,
is what `kros.data.Population` and the stages after it are for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from ..core import ROUNDING, Array, ConfigError, DataError, IdentificationError, MissingDependencyError, Whole
from ..identify import edmd, free_run
from ..identify.edmd import relative_pivots
from ..identify.factors import triangular
from ..lifting import Lifting

try:
    from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
    from sklearn.metrics import r2_score
    from sklearn.utils.validation import check_array, check_is_fitted, validate_data
except ImportError as error:
    raise MissingDependencyError(
        "KoopmanRegressor needs scikit-learn 1.6 or newer; install it (pip install 'kros[sklearn]'), or use "
        "kros.identify."
    ) from error


class KoopmanRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Koopman (or linear) model from rows of states and inputs to the next states.

    EDMD with Tikhonov regularisation (30)-(33): ``min ||theta(x+) - [A B][theta(x); u]||^2 + alpha ||[A B]||^2``, with
    ``theta(x)`` the states followed by the lifted functions. There is no intercept.

    ===========================  ==================================================================================
    ``X`` alone                  rows in order of time; each row is paired with the next one of its episode
    ``X`` and ``y``              rows pair up: ``y[k]`` is the next state of ``X[k]``; their order means nothing
    columns of an array          [episode,] states, inputs (as in pykoop)
    columns of a DataFrame       the same, with the names of states and inputs
    ===========================  ==================================================================================

    Parameters
    ----------
    functions : sequence of str
        Lifted functions as formulas of the states, such as ``"sin(100*position)"``; none for a linear model, and no
        delays.
    states : sequence of str, optional
        Names of the states, which the formulas use. Default: the names of the DataFrame, else ``x0, x1, ...``.
    n_inputs : int, optional
        How many of the last columns are inputs. Default: what `states` leave over, else what the columns of `y` leave
        over, else none.
    alpha : float
        Tikhonov coefficient, added to the unnormalised Gram matrix; zero for plain least squares.
    episode_feature : bool
        Whether the first column is the episode, a number.
    horizon : int or None
        `score` compares predictions this many samples ahead, from every sample, with the recorded inputs; None: the
        simulation of the whole episode from its first state.

    Notes
    -----
    `fit` sets ``A_``, shape (n_lifted, n_lifted), and ``B_``, shape (n_lifted, n_inputs); ``lifting_``,
    ``state_names_`` and ``input_names_``; and ``n_pairs_``, the number of transitions.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.interop import KoopmanRegressor
    >>> x = [0.9]
    >>> for _ in range(60):
    ...     x.append(1.2 * np.sin(x[-1]) + 0.1 * x[-1])
    >>> model = KoopmanRegressor(["sin(x0)"], horizon=None).fit(np.array(x)[:, None])
    >>> model.A_[0].round(6)
    array([0.1, 1.2])
    >>> round(model.score(np.array(x)[:, None]), 9)
    1.0
    """

    def __init__(
        self,
        functions: Sequence[str] = (),
        *,
        states: Sequence[str] | None = None,
        n_inputs: int | None = None,
        alpha: float = 0.0,
        episode_feature: bool = False,
        horizon: int | None = 1,
    ) -> None:
        self.functions = functions
        self.states = states
        self.n_inputs = n_inputs
        self.alpha = alpha
        self.episode_feature = episode_feature
        self.horizon = horizon

    def fit(self, X: Any, y: Any = None) -> Self:
        """Fit one model to all rows.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_columns)
        y : array_like, shape (n_samples, n_states) or (n_samples,), optional
            Next states. Default: the next row of the same episode.

        Returns
        -------
        KoopmanRegressor
            Itself.

        Raises
        ------
        DataError
            Columns that do not add up, and an interleaved or a too short episode. Also a ValueError.
        ConfigError
            A parameter or a formula that is not valid.
        IdentificationError
            With ``alpha = 0``, a function or input that depends on the others or does not vary; the message names it.
        """
        far = self.horizon is None or self.horizon >= 1
        if isinstance(self.functions, str) or not 0 <= self.alpha < np.inf or not far:
            raise ConfigError(
                "KoopmanRegressor: functions should be a list of texts, alpha at least zero and horizon at least one "
                f"or None, found {self.functions!r}, {self.alpha!r}, {self.horizon!r}."
            )
        values, edges = self._read(X, reset=True)
        checked = {"dtype": np.float64, "ensure_2d": False, "input_name": "y", "estimator": self}
        target = None if y is None else check_array(y, **checked)
        self._one_dimensional = target is not None and target.ndim == 1
        after = None if target is None else target.reshape(len(target), -1)
        if after is not None and len(after) != len(values):
            raise DataError(
                f"X has {len(values)} rows and y has {len(after)}; y holds the next state of every row of X."
            )
        self._name_columns(X, values.shape[1], None if after is None else after.shape[1])
        before, n = values, len(self.state_names_)
        if after is None:
            if np.diff(edges).min() < 2:
                raise DataError(
                    "KoopmanRegressor: an episode has n_samples = 1, a transition needs at least 2; leave the episode "
                    "out."
                )
            now = np.delete(np.arange(len(values)), edges[1:] - 1)
            before, after = values[now], values[now + 1, :n]
        with np.errstate(all="ignore"):
            rows = np.concatenate([self.lifting_.lift(before[:, :n]), before[:, n:], self.lifting_.lift(after)], axis=1)
        if not np.isfinite(rows).all():
            raise DataError(
                "KoopmanRegressor: a lifted function of X is NaN or inf in some row; choose functions that are "
                "defined everywhere."
            )
        R, names = triangular(rows), (*self.lifting_.names, *self.input_names_)
        if self.alpha == 0:
            _require_excited(R[: len(names), : len(names)], names, len(rows))
        matrices = edmd(R, self.lifting_.n_lifted, self.alpha)
        self.A_, self.B_, self.n_pairs_ = matrices.A, matrices.B, len(rows)
        return self

    def predict(self, X: Any) -> Array:
        """Predict the next state of every row, shape (n_samples, n_states), or (n_samples,) after such a `y`.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_columns)
            Columns as in `fit`. Rows are taken one by one: neither their order nor their episodes matter.
        """
        check_is_fitted(self)
        values, n = self._read(X, reset=False)[0], len(self.state_names_)
        predicted = self._step(values[:, :n], values[:, n:])
        return predicted[:, 0] if self._one_dimensional else predicted

    def score(self, X: Any, y: Any = None) -> float:
        """Return R2 of the prediction `horizon` samples ahead, the mean over the states; -inf where it diverges.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_columns)
        y : array_like, shape (n_samples, n_states), optional
            Next states, only for ``horizon = 1``. Default: the rows of `X` themselves, later in the same episode.

        Raises
        ------
        DataError
            Pairs of rows with another horizon than one, or fewer than two samples to compare with.
        """
        check_is_fitted(self)
        if y is not None:
            if self.horizon != 1:
                raise DataError(
                    f"score: pairs of rows (X, y) allow one step, the horizon is {self.horizon}; leave out y, or set "
                    "horizon = 1."
                )
            return _r2(np.asarray(y, dtype=float), self.predict(X))
        values, edges = self._read(X, reset=False)
        n, row = len(self.state_names_), np.arange(len(values))
        if self.horizon is None:
            later = np.delete(row, edges[:-1])
            return _r2(values[later, :n], self._free_run(values, edges)[later])
        start = np.flatnonzero(np.repeat(edges[1:], np.diff(edges)) - row > self.horizon)
        x = values[start, :n]
        for k in range(self.horizon):  # all rows at once
            x = self._step(x, values[start + k, n:])
        return _r2(values[start + self.horizon, :n], x)

    def _step(self, x: Array, u: Array) -> Array:
        W = np.concatenate([self.A_, self.B_], axis=1)[: len(self.state_names_)]
        with np.errstate(all="ignore"):
            return np.concatenate([self.lifting_.lift(x), u], axis=1) @ W.T

    def _free_run(self, values: Array, edges: Whole) -> Array:
        """Run all episodes as one batch, the shorter ones on with zero inputs and then cut."""
        n, lengths = len(self.state_names_), np.diff(edges)
        inside = np.arange(lengths.max()) < lengths[:, None]
        inputs = np.zeros((*inside.shape, len(self.input_names_)))
        inputs[inside] = values[:, n:]
        with np.errstate(all="ignore"):
            return free_run(self.A_, self.B_, self.lifting_, {}, values[edges[:-1], :n], inputs)[inside]

    def _read(self, X: Any, *, reset: bool) -> tuple[Array, Whole]:
        """Return states and inputs, and the first row of every episode with the number of rows."""
        values, ids = np.asarray(validate_data(self, X, reset=reset, dtype=np.float64)), None
        if self.episode_feature:
            ids, values = values[:, 0], values[:, 1:]
        if not values.shape[1]:
            raise DataError(
                "KoopmanRegressor: rows hold no state beside the episode; add the columns of states and inputs."
            )
        if not reset and values.shape[1] != len(self.state_names_) + len(self.input_names_):
            raise DataError(
                f"KoopmanRegressor: found {values.shape[1]} columns beside the episode; pass rows in the layout of "
                "`fit`."
            )
        inner = np.zeros(0, dtype=np.int64) if ids is None else np.flatnonzero(ids[1:] != ids[:-1]) + 1
        if ids is not None and len(set(ids[[0, *inner]].tolist())) <= len(inner):
            raise DataError(
                "KoopmanRegressor: an episode stands in several places; keep its rows together and in order of time."
            )
        return values, np.concatenate([[0], inner, [len(values)]]).astype(np.int64)

    def _name_columns(self, X: Any, n_columns: int, n_targets: int | None) -> None:
        """Name states and inputs; what is declared about their number has to agree."""
        declared = [n_targets] if n_targets is not None else []
        declared += [len(self.states)] if self.states is not None else []
        declared += [n_columns - self.n_inputs] if self.n_inputs is not None else []
        n = declared[0] if declared else n_columns
        if set(declared) - {n} or not 1 <= n <= n_columns:
            targets = f" and y with {n_targets} columns" if n_targets is not None else ""
            raise DataError(
                f"X has {n_columns} columns of states and inputs, which does not agree with n_inputs = "
                f"{self.n_inputs}, states = {self.states}{targets}."
            )
        named = hasattr(X, "iloc") and all(isinstance(c, str) for c in X.columns)
        frame = list(X.columns)[-n_columns:] if named else []
        names = frame or [f"x{i}" for i in range(n)] + [f"u{i}" for i in range(n_columns - n)]
        self.state_names_ = tuple(names[:n] if self.states is None else self.states)
        self.input_names_ = tuple(names[n:])
        if frame and self.state_names_ != tuple(frame[:n]):
            raise DataError(
                f"The states are {self.state_names_}, the frame has the columns {frame}; put the states first, the "
                "inputs after them."
            )
        self.lifting_ = Lifting(self.state_names_, tuple(self.functions), (), self.input_names_)
        if self.lifting_.history:
            raise ConfigError(
                "KoopmanRegressor: rows stand by themselves, functions cannot read earlier samples; use kros.identify."
            )

    def __sklearn_tags__(self) -> Any:
        """Return scikit-learn's facts about the estimator: no target is needed."""
        tags = super().__sklearn_tags__()
        tags.target_tags.required = False
        return tags


def _require_excited(R: Array, names: Sequence[str], n_pairs: int) -> None:
    """Name the first column that plain least squares cannot tell from those before it."""
    if n_pairs < len(names):
        raise DataError(
            f"Found n_samples = {n_pairs} transitions for {len(names)} unknowns of every row of [A B]; record more, or "
            "use alpha > 0."
        )
    dependent = np.flatnonzero(relative_pivots(R) <= ROUNDING)
    if dependent.size:
        raise IdentificationError(
            f"With alpha = 0 {names[int(dependent[0])]!r} cannot be identified: it depends on the columns before it, "
            "or is zero; remove it, excite it, or use alpha > 0."
        )


def _r2(truth: Array, predicted: Array) -> float:
    if len(truth) < 2:
        raise DataError(
            f"score: found {len(truth)} samples to compare with, R2 needs 2; pass longer episodes, or lower the "
            "horizon."
        )
    return float(r2_score(truth, predicted)) if np.isfinite(predicted).all() else -np.inf
