"""The scikit-learn estimator: its protocol, exact models, layouts of rows, and recordings that cannot be used."""

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


def recording(lengths: tuple[int, ...] = (60, 40, 50)) -> np.ndarray:
    return np.concatenate([np.column_stack([np.full(n, i), episode(n, i)]) for i, n in enumerate(lengths)])


def frame() -> pd.DataFrame:
    return pd.DataFrame(recording(), columns=["episode", *NAMES])


def pairs() -> tuple[np.ndarray, np.ndarray]:
    """Rows and their next states, of all episodes."""
    X = recording()
    inside = np.flatnonzero(np.diff(X[:, 0]) == 0)
    return X[inside, 1:], X[inside + 1, 1:3]


def regressor(**options: Any) -> KoopmanRegressor:
    return KoopmanRegressor(
        **{"functions": FUNCTIONS, "states": NAMES[:2], "n_inputs": 1, "episode_feature": True, **options}
    )


def is_exact(model: KoopmanRegressor) -> bool:
    rows = np.concatenate([model.A_[:2], model.B_[:2]], axis=1)
    return bool(np.allclose(rows, np.column_stack([A, C, B]), atol=1e-11))


# Rows are a time series only where y is absent; the checks pass y, so all of them apply and none is expected to fail.
@parametrize_with_checks([KoopmanRegressor(), KoopmanRegressor(alpha=0.1), KoopmanRegressor(("x0**2",), alpha=0.1)])
def test_protocol_of_scikit_learn(estimator: Any, check: Any) -> None:
    check(estimator)


# ---------------------------------------------------------------------------------------------------------------- exact models


@pytest.mark.parametrize("horizon", [1, 2, 7, 39, None])
def test_an_exact_model_scores_one(horizon: int | None) -> None:
    model = regressor(horizon=horizon).fit(recording())
    assert is_exact(model)
    assert abs(1 - model.score(recording())) < 1e-12


def test_the_score_is_that_of_predictions_one_by_one() -> None:
    model, X, h = regressor(functions=()).fit(recording()), recording(), 5
    truth, predicted = [], []
    for e in range(3):
        rows = X[X[:, 0] == e, 1:]
        for k in range(len(rows) - h):
            x = rows[k, :2]
            for j in range(h):
                x = model.A_ @ x + model.B_[:, 0] * rows[k + j, 2]
            predicted.append(x)
            truth.append(rows[k + h, :2])
    y, x = np.array(truth), np.array(predicted)
    r2 = np.mean(1 - ((y - x) ** 2).sum(axis=0) / ((y - y.mean(axis=0)) ** 2).sum(axis=0))
    assert model.set_params(horizon=h).score(X) == pytest.approx(r2, abs=1e-12)


def test_alpha_is_that_of_the_normal_equations() -> None:
    X, alpha = episode(80), 0.7
    model = KoopmanRegressor(["sin(x0)"], n_inputs=1, alpha=alpha).fit(X)
    theta = np.column_stack([X[:, :2], np.sin(X[:, 0])])
    Psi = np.column_stack([theta, X[:, 2]])[:-1]
    U = np.linalg.solve(Psi.T @ Psi + alpha * np.eye(4), Psi.T @ theta[1:]).T
    assert np.allclose(np.concatenate([model.A_, model.B_], axis=1), U, atol=1e-12)


# ------------------------------------------------------------------------------------------------------------- layouts of rows


def test_one_array_is_one_episode() -> None:
    assert is_exact(regressor(episode_feature=False).fit(episode()))


def test_pairs_of_rows_in_any_order() -> None:
    X, y = pairs()
    order = np.random.default_rng(0).permutation(len(X))
    model = regressor(episode_feature=False).fit(X[order], y[order])
    assert is_exact(model)
    assert abs(1 - model.score(X, y)) < 1e-12
    with pytest.raises(DataError, match="horizon is 3"):
        model.set_params(horizon=3).score(X, y)


def test_columns_of_a_frame_give_their_names() -> None:
    model = KoopmanRegressor(FUNCTIONS, n_inputs=1, episode_feature=True).fit(frame())
    assert is_exact(model)
    assert (model.state_names_, model.input_names_, model.n_pairs_) == (("angle", "rate"), ("voltage",), 147)
    assert np.array_equal(model.predict(frame()[NAMES].assign(episode=0)[["episode", *NAMES]]), model.predict(frame()))


# --------------------------------------------------------------------------------------------- together with scikit-learn's own


def test_a_grid_search_over_whole_episodes_finds_the_true_lifting() -> None:
    X = recording((60, 60, 60, 60))
    grid = {"functions": [(), ("angle**2",), FUNCTIONS], "alpha": [0.0, 1.0]}
    search = GridSearchCV(regressor(horizon=10), grid, cv=GroupKFold(4)).fit(X, groups=X[:, 0].astype(int))
    assert search.best_params_ == {"functions": FUNCTIONS, "alpha": 0.0}
    assert abs(1 - search.best_score_) < 1e-12


# -------------------------------------------------------------------------------------------------- what is refused, and how


@pytest.mark.parametrize(
    ("package", "call"),
    [
        ("sklearn", "kros.interop.KoopmanRegressor"),
        ("control", "kros.interop.to_control"),
    ],
)
def test_what_is_not_installed_is_named_when_it_is_needed(package: str, call: str) -> None:
    code = (
        f"import sys; sys.modules[{package!r}] = None\n"
        "import kros, kros.interop\n"
        "from kros.core import MissingDependencyError\n"
        f"try:\n    {call}\nexcept MissingDependencyError as error:\n    assert {f'kros[{package}]'!r} in str(error)\n"
        "else:\n    raise SystemExit('no error')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_what_cannot_be_used_is_refused() -> None:
    X = episode()
    for wrong, message in (
        ({"n_inputs": 3}, "does not agree"),
        ({"functions": "sin(x0)"}, "list of texts"),
        ({"horizon": 0}, "horizon at least one"),
        ({"functions": ["sin(x0[-1])"], "n_inputs": 1}, "earlier samples"),
        ({"functions": ["log(x0 - 1e9)"], "n_inputs": 1}, "NaN or inf"),
    ):
        with pytest.raises(ValueError, match=message):
            KoopmanRegressor(**wrong).fit(X)
    with pytest.raises(IdentificationError, match="'x2' cannot be identified"):
        KoopmanRegressor().fit(np.column_stack([X[:, :2], X[:, 0] + X[:, 1]]))
    with pytest.raises(DataError, match="several places"):
        KoopmanRegressor(n_inputs=1, episode_feature=True).fit(np.column_stack([np.arange(60) // 15 % 2, X]))
