"""Identification of one Koopman model as a scikit-learn regressor, for pipelines, grid searches and cross-validation.

One model is fitted to all rows, of whatever unit. A batch of units with a model each, and the uncertainty between them,
is what `kros.data.Population` and the stages after it are for.
"""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from ..core import Array, ConfigError, DataError, MissingDependencyError
from ..identify import edmd
from ..identify.factors import triangular
from ..lifting import Lifting

try:
    from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError as error:
    text = "KoopmanRegressor needs scikit-learn 1.6 or newer; install it, pip install 'kros[sklearn]'."
    raise MissingDependencyError(text) from error


class KoopmanRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Koopman (or linear) model from rows of states and inputs to the next states.

    EDMD with Tikhonov regularisation (30)-(33): ``min ||theta(x+) - [A B][theta(x); u]||^2 + alpha ||[A B]||^2``, with
    ``theta(x)`` the states followed by the lifted functions. There is no intercept.

    Parameters
    ----------
    functions : sequence of str
        Lifted functions as formulas of the states, such as ``"sin(100*position)"``; none for a linear model, and no
        delays. States have the names of a DataFrame's columns, else ``x0, x1, ...``.
    alpha : float
        Tikhonov coefficient, added to the unnormalised Gram matrix; zero for plain least squares.

    Notes
    -----
    `fit` sets ``A_``, shape (n_lifted, n_lifted), ``B_``, shape (n_lifted, n_inputs), and ``lifting_``.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.interop import KoopmanRegressor
    >>> x = [0.9]
    >>> for _ in range(60):
    ...     x.append(1.2 * np.sin(x[-1]) + 0.1 * x[-1])
    >>> now, after = np.array(x[:-1])[:, None], np.array(x[1:])[:, None]
    >>> model = KoopmanRegressor(["sin(x0)"]).fit(now, after)
    >>> model.A_[0].round(6)
    array([0.1, 1.2])
    >>> round(model.score(now, after), 9)
    1.0
    """

    def __init__(self, functions: Sequence[str] = (), *, alpha: float = 0.0) -> None:
        self.functions = functions
        self.alpha = alpha

    def fit(self, X: Any, y: Any) -> Self:
        """Fit one model to all rows.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_states + n_inputs)
            States, then inputs.
        y : array_like, shape (n_samples, n_states) or (n_samples,)
            The next state of every row of `X`.

        Returns
        -------
        KoopmanRegressor
            Itself.

        Raises
        ------
        DataError
            Fewer columns of `X` than of `y`, or functions that are not finite. Also a ValueError.
        ConfigError
            A parameter or a formula that is not valid.
        IdentificationError
            With ``alpha = 0``, a function or input that depends on the others or does not vary.
        """
        if isinstance(self.functions, str) or not 0 <= self.alpha < np.inf:
            wanted = "functions should be a list of texts and alpha at least zero"
            raise ConfigError(f"KoopmanRegressor: {wanted}, found {self.functions!r}, {self.alpha!r}.")
        X, y = validate_data(self, X, y, dtype=np.float64, multi_output=True, y_numeric=True, ensure_min_samples=2)
        self._one_dimensional, after = y.ndim == 1, y.reshape(len(y), -1).astype(float)
        n, columns = after.shape[1], X.shape[1]
        if n > columns:
            raise DataError(f"X has {columns} columns and y has {n}; X holds all states, then the inputs.")
        names = getattr(self, "feature_names_in_", [f"x{i}" for i in range(n)] + [f"u{i}" for i in range(columns - n)])
        self.lifting_ = Lifting(tuple(names[:n]), tuple(self.functions), (), tuple(names[n:]))
        if self.lifting_.history:
            raise ConfigError("KoopmanRegressor: functions of rows cannot read earlier samples; use kros.identify.")
        with np.errstate(all="ignore"):
            rows = np.concatenate([self.lifting_.lift(X[:, :n]), X[:, n:], self.lifting_.lift(after)], axis=1)
        if not np.isfinite(rows).all():
            problem = "a lifted function of X is NaN or inf in some row"
            raise DataError(f"KoopmanRegressor: {problem}; choose functions that are defined everywhere.")
        matrices = edmd(triangular(rows), self.lifting_.n_lifted, self.alpha)
        self.A_, self.B_ = matrices.A, matrices.B
        return self

    def predict(self, X: Any) -> Array:
        """Predict the next state of every row, shape (n_samples, n_states), or (n_samples,) after such a `y`.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n_samples, n_states + n_inputs)
        """
        check_is_fitted(self)
        X, n = validate_data(self, X, reset=False, dtype=np.float64), self.lifting_.n_states
        with np.errstate(all="ignore"):
            predicted = self.lifting_.lift(X[:, :n]) @ self.A_[:n].T + X[:, n:] @ self.B_[:n].T
        return predicted[:, 0] if self._one_dimensional else predicted
