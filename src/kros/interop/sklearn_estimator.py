"""Identification of one Koopman model as a scikit-learn regressor, for pipelines, grid searches and cross-validation.

    rows (x_k, u_k) ──► lifting ──► [theta(x_k) u_k] ──► [A B] ──► x_{k+1}          predict: one row, one step
                           ▲                               │
                           └───────────── x ◄──────────────┘                        predict_trajectory: retract and re-lift

One model is fitted to all rows, of whatever unit. A batch of units with a model each, and the uncertainty between them, is what
`kros.data.Population` and the stages after it are for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, MissingDependencyError
from ..identify import edmd, free_run
from ..identify.factors import triangular
from ..lifting import Lifting
from .quality import check_excitation, r_squared
from .rows import Columns, episode_edges, finite, is_whole, split_columns

try:
    from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
    from sklearn.utils.validation import check_array, check_is_fitted, validate_data
except ImportError as error:
    raise MissingDependencyError(
        "KoopmanRegressor needs scikit-learn 1.6 or newer; install it (pip install 'kros[sklearn]'), or identify with kros.identify."
    ) from error

Array = npt.NDArray[np.float64]


class KoopmanRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Koopman (or linear) model from rows of states and inputs to the next states.

    EDMD with Tikhonov regularisation (30)-(33): ``min ||theta(x+) - [A B][theta(x); u]||^2 + alpha ||[A B]||^2``, with ``theta(x)`` the
    states followed by the lifted functions. There is no intercept.

    ===========================  ==================================================================================
    ``X`` alone                  rows in order of time; each row is paired with the next one of its episode
    ``X`` and ``y``              rows pair up: ``y[k]`` is the next state of ``X[k]``; their order means nothing
    columns of an array          [episode,] states, inputs (as in pykoop)
    columns of a DataFrame       states, inputs; a column named ``episode`` is the episode wherever it stands
    ===========================  ==================================================================================

    Episode ids are whole numbers or text. Rows of an episode have to stand together and are never sorted. Where `y` is given, episodes
    are ignored.

    Parameters
    ----------
    functions : sequence of str
        Lifted functions as formulas of the states, such as ``"sin(100*position)"``; none for a linear model. Rows stand by themselves, so
        there are no delays (``position[-1]``): put earlier samples into columns of their own.
    states : sequence of str, optional
        Names of the states, which the formulas use. A DataFrame has to begin with columns of these names. Default: the names of the
        DataFrame, else ``x0, x1, ...``.
    n_inputs : int, optional
        How many of the last columns are inputs. Default: what `states` leave over, else what the columns of `y` leave over, else none.
    alpha : float
        Tikhonov coefficient, added to the unnormalised Gram matrix; zero for plain least squares.
    episode_feature : bool
        Whether the first column of an array is the episode.
    horizon : int or None
        `score` compares predictions this many samples ahead, from every sample, with the recorded inputs; None: the free run of the
        whole episode from its first state.

    Notes
    -----
    `fit` sets ``A_``, shape (n_lifted, n_lifted), and ``B_``, shape (n_lifted, n_inputs); ``lifting_``, ``state_names_`` and
    ``input_names_``; ``n_pairs_``, the number of transitions; ``n_features_in_``, the number of columns with the episode; and
    ``feature_names_in_``, their names, where `X` was a DataFrame.

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

    # ------------------------------------------------------------------------------------------------------- identification

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
            Rows that cannot be used as they are: NaN, ids that rounding may have merged, an interleaved or a too short episode.
            Also a ValueError.
        ConfigError
            A parameter or a formula that is not valid.
        IdentificationError
            With ``alpha = 0``, a function or input that depends on the others or does not vary; the message names it.
        """
        self._check_parameters()
        columns, values = self._read(X, reset=True)
        target = None if y is None else self._read_target(y, len(values))
        self._one_dimensional = target is not None and target.ndim == 1
        target = None if target is None else target.reshape(len(values), -1)
        self._name_columns(columns, values.shape[1], None if target is None else target.shape[1])
        values = finite(values, self.state_names_ + self.input_names_, "Input X")
        if target is None:
            edges = episode_edges(columns, len(values))
            now = np.delete(np.arange(len(values)), edges[1:] - 1)
            before, after = values[now], values[now + 1, : self._n_states]
        else:
            before, after = values, target
        self._identify(before, after)
        return self

    def _identify(self, before: Array, after: Array) -> None:
        n, n_lifted = self._n_states, self.lifting_.n_lifted
        names = (*self.lifting_.names, *self.input_names_)
        rows = np.concatenate([self._psi(before[:, :n], before[:, n:]), self._lift(after)], axis=1)
        finite(rows, (*names, *self.lifting_.names), "A lifted function of X is not defined everywhere: the lifted X")
        R = triangular(rows)
        if self.alpha == 0:
            check_excitation(R[: len(names), : len(names)], names, n, n_lifted, len(rows))
        matrices = edmd(R, n_lifted, self.alpha)
        self.A_, self.B_, self.n_pairs_ = matrices.A, matrices.B, len(rows)

    def _lift(self, x: Array) -> Array:
        with np.errstate(all="ignore"):
            return self.lifting_.lift(x)

    def _psi(self, x: Array, u: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.concatenate([self._lift(x), u], axis=1)

    # ----------------------------------------------------------------------------------------------------------- prediction

    def predict(self, X: Any) -> Array:
        """Predict the next state of every row.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_columns)
            Columns as in `fit`. Rows are taken one by one: neither their order nor their episodes matter.

        Returns
        -------
        ndarray, shape (n_samples, n_states)
            Row k is the state one step after row k. Of shape (n_samples,) where `fit` was given a `y` of one dimension.
        """
        check_is_fitted(self)
        _, values = self._read_fitted(X)
        predicted = self._step(values[:, : self._n_states], values[:, self._n_states :])
        return predicted[:, 0] if self._one_dimensional else predicted

    def predict_trajectory(self, X: Any) -> Array:
        """Predict whole episodes from their first state and the recorded inputs.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_columns)
            Of the states only the first row of each episode is used; the state is retracted and lifted again at every step.

        Returns
        -------
        ndarray, shape (n_samples, n_states)
            Row k belongs to row k of `X` (not to the one after it). A run that diverges holds infinities or NaN.
        """
        check_is_fitted(self)
        columns, values = self._read_fitted(X)
        return self._free_run(values, episode_edges(columns, len(values)))

    def score(self, X: Any, y: Any = None) -> float:
        """Return R2 of the prediction `horizon` samples ahead, the mean over the states.

        A state that does not vary counts one where it is predicted to rounding, else zero.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_columns)
        y : array_like, shape (n_samples, n_states), optional
            Next states, only for ``horizon = 1``. Default: the rows of `X` themselves, later in the same episode.

        Returns
        -------
        float
            One for an exact model; minus infinity where the prediction diverges. Episodes of `horizon` samples and less add nothing.

        Raises
        ------
        DataError
            Fewer than two samples to compare with.
        """
        check_is_fitted(self)
        self._check_parameters()
        if y is not None:
            if self.horizon != 1:
                raise DataError(
                    f"score: pairs of rows (X, y) allow one step, the horizon is {self.horizon}; leave out y, or set horizon = 1."
                )
            predicted = self.predict(X)
            return r_squared(self._read_target(y, len(predicted)), predicted)
        columns, values = self._read_fitted(X)
        edges = episode_edges(columns, len(values))
        truth = values[:, : self._n_states]
        if self.horizon is None:
            later = np.delete(np.arange(len(values)), edges[:-1])
            return r_squared(truth[later], self._free_run(values, edges)[later])
        lengths = np.diff(edges)
        start = np.flatnonzero(np.repeat(edges[1:], lengths) - np.arange(len(values)) > self.horizon)
        x = truth[start]
        for k in range(self.horizon):  # all rows at once
            x = self._step(x, values[start + k, self._n_states :])
        return r_squared(truth[start + self.horizon], x)

    def _step(self, x: Array, u: Array) -> Array:
        n = self._n_states
        with np.errstate(all="ignore"):
            return np.asarray(self._psi(x, u) @ np.concatenate([self.A_[:n], self.B_[:n]], axis=1).T)

    def _free_run(self, values: Array, edges: npt.NDArray[np.int64]) -> Array:
        """Run all episodes as one batch, the shorter ones on with zero inputs and then cut."""
        n, lengths = self._n_states, np.diff(edges)
        inside = np.arange(lengths.max()) < lengths[:, None]
        inputs = np.zeros((*inside.shape, len(self.input_names_)))
        inputs[inside] = values[:, n:]
        with np.errstate(all="ignore"):
            return free_run(self.A_, self.B_, self.lifting_, {}, values[edges[:-1], :n], inputs)[inside]

    # --------------------------------------------------------------------------------------------------------------- checks

    @property
    def _n_states(self) -> int:
        return len(self.state_names_)

    def _check_parameters(self) -> None:
        for name, value in (("functions", self.functions), ("states", self.states)):
            if isinstance(value, str):
                raise ConfigError(f"KoopmanRegressor: {name} should be a list of texts, found the text {value!r}; write [{value!r}].")
        if not isinstance(self.alpha, (int, float, np.number)) or not 0 <= float(self.alpha) < np.inf:
            raise ConfigError(f"KoopmanRegressor: alpha should be a number of at least zero, found {self.alpha!r}.")
        if self.n_inputs is not None and (not is_whole(self.n_inputs) or self.n_inputs < 0):
            raise ConfigError(f"KoopmanRegressor: n_inputs should be a whole number of at least zero, found {self.n_inputs!r}.")
        if self.horizon is not None and (not is_whole(self.horizon) or self.horizon < 1):
            raise ConfigError(f"KoopmanRegressor: horizon should be a whole number of samples, or None, found {self.horizon!r}.")

    def _read(self, X: Any, *, reset: bool) -> tuple[Columns, Array]:
        """Return ids and numbers, after the checks that scikit-learn makes of every estimator."""
        options = {"dtype": np.float64, "ensure_all_finite": False, "estimator": self, "input_name": "X"}
        if (not self.episode_feature and not hasattr(X, "iloc")) or hasattr(X, "toarray"):
            values = validate_data(self, X, reset=reset, dtype=np.float64, ensure_all_finite=False)
            return Columns(values, None), values
        columns = split_columns(X, episode_feature=self.episode_feature)
        validate_data(self, X if hasattr(X, "iloc") else np.asarray(X), reset=reset, skip_check_array=True)
        return columns, check_array(columns.values, **options)

    def _read_fitted(self, X: Any) -> tuple[Columns, Array]:
        """Read rows with the columns of those that the model was fitted to."""
        columns, values = self._read(X, reset=False)
        names = self.state_names_ + self.input_names_
        if values.shape[1] != len(names):
            found = columns.names or f"{values.shape[1]} columns"
            raise DataError(
                f"The model has the states and inputs {names}, found {found} besides the episode; pass rows in the layout of `fit`, where an "
                "array has the episode first (episode_feature = True) and a frame has it by name."
            )
        return columns, finite(values, names, "Input X")

    def _read_target(self, y: Any, n_samples: int) -> Array:
        target = check_array(y, dtype=np.float64, ensure_2d=False, ensure_all_finite=False, input_name="y", estimator=self)
        if len(target) != n_samples:
            raise DataError(f"X has {n_samples} rows and y has {len(target)}; y holds the next state of every row of X.")
        rows = target.reshape(len(target), -1)
        finite(rows, [str(i) for i in range(rows.shape[1])], "Target y")
        return target

    def _name_columns(self, columns: Columns, n_columns: int, n_targets: int | None) -> None:
        n_states = self._count_states(n_columns, n_targets)
        names = columns.names or tuple([f"x{i}" for i in range(n_states)] + [f"u{i}" for i in range(n_columns - n_states)])
        if self.states is not None:
            wanted = tuple(self.states)
            if columns.names is not None and columns.names[:n_states] != wanted:
                raise DataError(
                    f"The states are {wanted}, the frame has the columns {columns.names}; reorder it so that the states come first and "
                    "the inputs after them."
                )
            names = wanted + names[n_states:]
        self.state_names_, self.input_names_ = names[:n_states], names[n_states:]
        self.lifting_ = Lifting(self.state_names_, tuple(self.functions), (), self.input_names_)
        if self.lifting_.history:
            raise ConfigError(
                f"KoopmanRegressor: the functions read {', '.join(self.lifting_.window.earlier)}, but rows stand by themselves; put earlier samples "
                "into columns of their own, or identify recordings with kros.identify."
            )

    def _count_states(self, n_columns: int, n_targets: int | None) -> int:
        """Return the number of states on which everything that was said agrees."""
        said = {
            f"n_inputs = {self.n_inputs}": None if self.n_inputs is None else n_columns - int(self.n_inputs),
            f"states = {self.states}": None if self.states is None else len(self.states),
            f"y with {n_targets} columns (next states)": n_targets,
        }
        counts = {text: count for text, count in said.items() if count is not None} or {"no inputs": n_columns}
        found = set(counts.values())
        count = min(found)
        if len(found) > 1 or not 1 <= count <= n_columns:
            raise DataError(
                f"X has {n_columns} columns of states and inputs, which does not agree with {' and '.join(counts)}; "
                "states and inputs should add up to the columns, without that of the episode, and at least one is a state."
            )
        return count

    def __sklearn_tags__(self) -> Any:
        """Return scikit-learn's facts about the estimator: no target is needed."""
        tags = super().__sklearn_tags__()
        tags.target_tags.required = False
        return tags
