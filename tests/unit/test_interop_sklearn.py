"""The scikit-learn estimator: its protocol, exact models, and rows that cannot be used."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.utils.estimator_checks import parametrize_with_checks

from kros.core import DataError, IdentificationError
from kros.interop import KoopmanRegressor

A = np.array([[0.95, 0.1], [-0.2, 0.8]])
B = np.array([0.05, 0.3])
C = np.array([0.0, -0.4])  # of sin(x0)
FUNCTIONS = ("sin(angle)",)
NAMES = ["angle", "rate", "voltage"]


def episode(n: int = 60, seed: int = 0) -> np.ndarray:
    """Rows of a pendulum-like system that a lifting with a sine describes exactly in its states."""
    rng = np.random.default_rng(seed)
    x, rows = rng.normal(size=2), []
    for u in rng.normal(size=n):
        rows.append([*x, u])
        x = A @ x + B * u + C * np.sin(x[0])
    return np.array(rows)


def pairs(*lengths: int) -> tuple[pd.DataFrame, np.ndarray, np.ndarray]:
    """Rows and their next states, and the episodes that they are of."""
    episodes = [episode(n, i) for i, n in enumerate(lengths)]
    X, y = (np.concatenate(parts) for parts in ([e[:-1] for e in episodes], [e[1:, :2] for e in episodes]))
    return pd.DataFrame(X, columns=NAMES), y, np.repeat(np.arange(len(lengths)), np.array(lengths) - 1)


@parametrize_with_checks([KoopmanRegressor(), KoopmanRegressor(alpha=0.1), KoopmanRegressor(("x0**2",), alpha=0.1)])
def test_protocol_of_scikit_learn(estimator: Any, check: Any) -> None:
    check(estimator)


def test_an_exact_model_is_found_from_pairs_in_any_order_and_scores_one() -> None:
    X, y, _ = pairs(60, 40, 50)
    order = np.random.default_rng(0).permutation(len(X))
    model = KoopmanRegressor(FUNCTIONS).fit(X.iloc[order], y[order])
    rows = np.concatenate([model.A_[:2], model.B_[:2]], axis=1)
    assert np.allclose(rows, np.column_stack([A, C, B]), atol=1e-11)
    assert abs(1 - model.score(X, y)) < 1e-12
    assert (model.lifting_.states, model.lifting_.inputs) == (("angle", "rate"), ("voltage",))


def test_alpha_is_that_of_the_normal_equations() -> None:
    X, alpha = episode(80), 0.7
    model = KoopmanRegressor(["sin(x0)"], alpha=alpha).fit(X[:-1], X[1:, :2])
    theta = np.column_stack([X[:, :2], np.sin(X[:, 0])])
    Psi = np.column_stack([theta, X[:, 2]])[:-1]
    U = np.linalg.solve(Psi.T @ Psi + alpha * np.eye(4), Psi.T @ theta[1:]).T
    assert np.allclose(np.concatenate([model.A_, model.B_], axis=1), U, atol=1e-12)


def test_a_grid_search_over_whole_episodes_finds_the_true_lifting() -> None:
    X, y, episodes = pairs(60, 60, 60, 60)
    grid = {"functions": [(), ("angle**2",), FUNCTIONS], "alpha": [0.0, 1.0]}
    search = GridSearchCV(KoopmanRegressor(), grid, cv=GroupKFold(4)).fit(X, y, groups=episodes)
    assert search.best_params_ == {"functions": FUNCTIONS, "alpha": 0.0}
    assert abs(1 - search.best_score_) < 1e-12


@pytest.mark.parametrize(("package", "call"), [("sklearn", "KoopmanRegressor"), ("control", "to_control")])
def test_what_is_not_installed_is_named_when_it_is_needed(package: str, call: str) -> None:
    code = (
        f"import sys; sys.modules[{package!r}] = None\n"
        "import kros, kros.interop\n"
        "from kros.core import MissingDependencyError\n"
        f"try:\n    kros.interop.{call}\nexcept MissingDependencyError as error:\n    assert {f'kros[{package}]'!r} in str(error)\n"
        "else:\n    raise SystemExit('no error')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_what_cannot_be_used_is_refused() -> None:
    X = episode()
    now, after = X[:-1], X[1:, :2]
    for wrong, message in (
        ({"functions": "sin(x0)"}, "list of texts"),
        ({"functions": ["sin(x0[-1])"]}, "earlier samples"),
        ({"functions": ["log(x0 - 1e9)"]}, "NaN or inf"),
    ):
        with pytest.raises(ValueError, match=message):
            KoopmanRegressor(**wrong).fit(now, after)
    with pytest.raises(DataError, match="X has 2 columns and y has 3"):
        KoopmanRegressor().fit(now[:, :2], X[1:])
    with pytest.raises(IdentificationError):
        KoopmanRegressor().fit(np.column_stack([now[:, :2], now[:, 0] + now[:, 1]]), after)
