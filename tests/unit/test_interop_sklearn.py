"""The scikit-learn estimator: its protocol, exact models, layouts of rows, and recordings that cannot be used."""

from __future__ import annotations

import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.compose import ColumnTransformer
from sklearn.model_selection import GridSearchCV, GroupKFold, KFold, cross_val_score
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

from kros.core import ConfigError, DataError, IdentificationError
from kros.identify import edmd
from kros.identify.factors import triangular
from kros.interop import KoopmanRegressor

A = np.array([[0.95, 0.1], [-0.2, 0.8]])
B = np.array([0.05, 0.3])
C = np.array([0.0, -0.4])  # of sin(x0)
FUNCTIONS = ("sin(angle)",)
NAMES = ["angle", "rate", "voltage"]
LARGE = 2**60


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


def frame(ids: tuple[Any, ...] = ("a", "b", "c"), lengths: tuple[int, ...] = (60, 40, 50)) -> pd.DataFrame:
    parts = [pd.DataFrame(episode(n, i), columns=NAMES).assign(episode=e) for i, (e, n) in enumerate(zip(ids, lengths, strict=True))]
    return pd.concat(parts, ignore_index=True)


def pairs() -> tuple[np.ndarray, np.ndarray]:
    """Rows and their next states, of all episodes."""
    X = recording()
    inside = np.flatnonzero(np.diff(X[:, 0]) == 0)
    return X[inside, 1:], X[inside + 1, 1:3]


def regressor(**options: Any) -> KoopmanRegressor:
    return KoopmanRegressor(**{"functions": FUNCTIONS, "states": NAMES[:2], "n_inputs": 1, "episode_feature": True, **options})


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


def test_a_wrong_model_scores_less_the_further_it_looks() -> None:
    model = regressor(functions=()).fit(recording())
    scores = [model.set_params(horizon=h).score(recording()) for h in (1, 3, 10)]
    assert scores[0] < 1 - 1e-6
    assert scores[0] > scores[1] > scores[2]


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


def test_predictions_stand_where_they_belong() -> None:
    X = recording()
    model = regressor().fit(X)
    inside = np.flatnonzero(np.diff(X[:, 0]) == 0)
    assert np.allclose(model.predict(X)[inside], X[inside + 1, 1:3], atol=1e-12)
    assert np.allclose(model.predict_trajectory(X), X[:, 1:3], atol=1e-9)
    assert np.array_equal(model.predict(X[::-1]), model.predict(X)[::-1])


def test_a_trajectory_needs_only_the_first_state() -> None:
    X = recording()
    model = regressor().fit(X)
    hidden = X.copy()
    first = np.flatnonzero(np.diff(X[:, 0], prepend=-1))
    hidden[np.setdiff1d(np.arange(len(X)), first), 1:3] = 99.0
    assert np.allclose(model.predict_trajectory(hidden), X[:, 1:3], atol=1e-9)


def test_alpha_is_that_of_the_normal_equations() -> None:
    X, alpha = episode(80), 0.7
    model = KoopmanRegressor(["sin(x0)"], n_inputs=1, alpha=alpha).fit(X)
    theta = np.column_stack([X[:, :2], np.sin(X[:, 0])])
    Psi = np.column_stack([theta, X[:, 2]])[:-1]
    U = np.linalg.solve(Psi.T @ Psi + alpha * np.eye(4), Psi.T @ theta[1:]).T
    assert np.allclose(np.concatenate([model.A_, model.B_], axis=1), U, atol=1e-12)


def test_badly_scaled_states_are_identified() -> None:
    X = episode() * np.array([1.0, 1e-8, 1.0])
    model = KoopmanRegressor(n_inputs=1).fit(X)
    Psi, after = X[:-1], X[1:, :2]
    R = triangular(np.concatenate([Psi, after], axis=1))
    reference = edmd(R, 2)
    assert np.allclose(model.A_, reference.A, rtol=1e-12)
    assert abs(model.A_[1, 1] - np.linalg.lstsq(episode()[:-1], episode()[1:, :2], rcond=None)[0][1, 1]) < 1e-9


def test_a_state_that_does_not_vary_is_no_loss() -> None:
    X, y = pairs()
    load = np.full((len(X), 1), 0.3)
    model = KoopmanRegressor(["sin(x0)"], n_inputs=1)
    X, y = np.concatenate([X[:, :2], load, X[:, 2:]], axis=1), np.concatenate([y, load], axis=1)
    model.fit(X, y)
    assert abs(1 - model.score(X, y)) < 1e-12
    assert model.score(X, y + np.array([0, 0, 1e-3])) == pytest.approx(2 / 3, abs=1e-12)


def test_a_target_of_another_width_is_refused() -> None:
    X, y = pairs()
    model = regressor(episode_feature=False).fit(X, y)
    with pytest.raises(DataError, match="y has 1 columns, the model has 2 states"):
        model.score(X, y[:, 0])


def test_a_diverging_prediction_scores_minus_infinity() -> None:
    growth = np.array([[1e-3], [0.1], [10.0], [1000.0], [1e5]])
    model = KoopmanRegressor(["x0**9"], alpha=1e-9).fit(growth)
    model.A_ = np.array([[2.0, 1.0], [0.0, 0.0]])
    assert model.set_params(horizon=None).score(growth * 1e3) == -np.inf


# ------------------------------------------------------------------------------------------------------------- layouts of rows


def test_one_array_is_one_episode() -> None:
    assert is_exact(regressor(episode_feature=False).fit(episode()))


def test_episodes_are_not_joined() -> None:
    assert is_exact(regressor().fit(recording()))
    assert not is_exact(regressor(episode_feature=False).fit(recording()[:, 1:]))


def test_pairs_of_rows_in_any_order() -> None:
    X, y = pairs()
    order = np.random.default_rng(0).permutation(len(X))
    model = regressor(episode_feature=False).fit(X[order], y[order])
    assert is_exact(model)
    assert abs(1 - model.score(X, y)) < 1e-12
    with pytest.raises(DataError, match="horizon is 3"):
        model.set_params(horizon=3).score(X, y)


def test_the_columns_that_y_leaves_over_are_inputs() -> None:
    X, y = pairs()
    model = KoopmanRegressor(["sin(x0)"]).fit(X, y)
    assert is_exact(model)
    assert (model.state_names_, model.input_names_) == (("x0", "x1"), ("u0",))


def test_columns_of_a_frame_are_found_by_name() -> None:
    model = KoopmanRegressor(FUNCTIONS, n_inputs=1).fit(frame())
    assert is_exact(model)
    assert (model.state_names_, model.input_names_, model.n_pairs_) == (("angle", "rate"), ("voltage",), 147)
    assert (list(model.feature_names_in_), model.n_features_in_) == ([*NAMES, "episode"], 4)
    assert np.array_equal(model.predict(frame()), model.predict(frame().iloc[::-1])[::-1])
    first = frame()[["episode", *NAMES]].rename(columns={"episode": "run"})
    assert is_exact(regressor().fit(first))


@pytest.mark.parametrize("ids", [(LARGE, LARGE + 1, LARGE + 2), (-5, 0, 10**12), ("7", "8", "007"), (10**30, 10**30 + 1, 10**30 + 2)])
def test_ids_are_told_apart_exactly(ids: tuple[Any, ...]) -> None:
    assert regressor().fit(frame(ids)).n_pairs_ == 147
    rows = frame(ids)[["episode", *NAMES]].to_numpy(dtype=object)
    assert regressor().fit(rows).n_pairs_ == 147
    assert is_exact(regressor().fit(rows))


def test_large_whole_ids_of_an_integer_array_survive() -> None:
    rows = np.array([[LARGE, 1, 5], [LARGE, 2, -2], [LARGE, 4, 3], [LARGE + 1, 3, 1], [LARGE + 1, 7, 2]])
    assert KoopmanRegressor(n_inputs=1, episode_feature=True).fit(rows).n_pairs_ == 3


# --------------------------------------------------------------------------------------------- together with scikit-learn's own


def test_clone_parameters_and_pickling() -> None:
    model = regressor(horizon=4)
    twin = clone(model)
    assert twin.get_params() == model.get_params()
    assert not hasattr(twin.fit(recording()).set_params(alpha=2.0), "alpha_")
    assert twin.get_params()["alpha"] == 2.0
    again = pickle.loads(pickle.dumps(regressor().fit(recording())))
    assert np.array_equal(again.predict(recording()), regressor().fit(recording()).predict(recording()))


def test_a_grid_search_over_whole_episodes_finds_the_true_lifting() -> None:
    X = recording((60, 60, 60, 60))
    grid = {"functions": [(), ("angle**2",), FUNCTIONS], "alpha": [0.0, 1.0]}
    search = GridSearchCV(regressor(horizon=10), grid, cv=GroupKFold(4)).fit(X, groups=X[:, 0].astype(int))
    assert search.best_params_ == {"functions": FUNCTIONS, "alpha": 0.0}
    assert abs(1 - search.best_score_) < 1e-12


def test_folds_of_pairs_may_be_shuffled() -> None:
    X, y = pairs()
    model = KoopmanRegressor(["sin(x0)"], n_inputs=1)
    scores = cross_val_score(model, X, y, cv=KFold(5, shuffle=True, random_state=0))
    assert np.all(np.abs(1 - scores) < 1e-12)


def test_a_fold_that_cuts_an_episode_is_found_in_a_frame() -> None:
    with pytest.raises(DataError, match="index goes from 19 to 40 between rows 19 and 20"):
        KoopmanRegressor(n_inputs=1).fit(frame().drop(index=range(20, 40)))


def test_pipelines() -> None:
    X = episode()
    pipeline = make_pipeline(StandardScaler(with_mean=False), KoopmanRegressor(n_inputs=1, horizon=3)).fit(X)
    plain = KoopmanRegressor(n_inputs=1, horizon=3).fit(X)
    assert pipeline.score(X) == pytest.approx(plain.score(X), abs=1e-12)  # R2 does not depend on the unit of a state
    scaled = ColumnTransformer([("scale", StandardScaler(with_mean=False), [1, 2, 3])], remainder="passthrough")
    columns = ColumnTransformer([("episode", "passthrough", [0]), ("scale", StandardScaler(with_mean=False), [1, 2, 3])])
    model = KoopmanRegressor(n_inputs=1, episode_feature=True)
    assert Pipeline([("scale", columns), ("model", model)]).fit(recording()).score(recording()) > 0.9
    with pytest.raises(DataError, match="whole numbers"):  # the episode comes last, where the regressor does not look for it
        Pipeline([("scale", scaled), ("model", model)]).fit(recording())


# -------------------------------------------------------------------------------------------------- what is refused, and how


def refuses(X: Any, error: type[Exception], message: str, y: Any = None, **options: Any) -> None:
    with pytest.raises(error, match=message):
        regressor(**options).fit(X, y)


def with_ids(*ids: Any) -> np.ndarray:
    rows = recording((20, 20, 20)).astype(object)
    rows[:, 0] = np.repeat(np.array(ids, dtype=object), 20)
    return rows


def test_ids_that_rounding_may_have_merged_are_refused() -> None:
    X = recording()
    X[:, 0] = np.where(X[:, 0] > 0, 2.0**53 + 2, 1.0)
    refuses(X, DataError, r"Episode id 9007199254740994 in row 60 .* beyond 2\*\*53.*int64 or text")
    refuses(frame((2.0**60, 1.0, 2.0)), DataError, r"beyond 2\*\*53")
    refuses(with_ids(2.0**53, 1, 2), DataError, r"beyond 2\*\*53")
    single = recording().astype(np.float32)
    single[:, 0] += 2.0**24
    refuses(single, DataError, r"Episode id 16777216 in row 0 is a float32 beyond 2\*\*24")
    mixed = [[LARGE, 0.1, 0.2, 0.0], [LARGE + 1, 0.1, 0.2, 0.0]]  # a list of numbers becomes an array of floats
    refuses(mixed, DataError, r"beyond 2\*\*53")


@pytest.mark.parametrize("bad", [0.5, np.nan, np.inf])
def test_ids_that_are_no_whole_numbers_are_refused(bad: float) -> None:
    X = recording()
    X[3, 0] = bad
    refuses(X, DataError, f"whole numbers or text, found {bad} in row 3")


@pytest.mark.parametrize("bad", [None, True, (1, 2)])
def test_ids_of_other_kinds_are_refused(bad: Any) -> None:
    X = with_ids(0, 1, 2)
    X[25, 0] = bad
    refuses(X, DataError, "whole numbers or text, found .* in row 25")


def test_ids_of_mixed_kinds_are_refused() -> None:
    refuses(with_ids(1, "1", 2), DataError, "mix text .'1'. and numbers .1.")
    refuses(recording().astype(str), DataError, "array of text")


def test_an_interleaved_episode_is_refused() -> None:
    X = np.concatenate([recording()[:30], recording()[60:80], recording()[30:60]])
    refuses(X, DataError, "Episode 0 stands in rows 0 to 29 and again in rows 50 to 79")
    refuses(frame(("a", "b", "a")), DataError, "Episode a stands in rows 0 to 59 and again in rows 100 to 149")
    model = regressor().fit(recording())
    for method in (model.score, model.predict_trajectory):
        with pytest.raises(DataError, match="again in rows"):
            method(X)
    assert model.predict(X).shape == (80, 2)  # rows by themselves need no order


def test_rows_of_a_frame_that_are_not_in_order_are_refused() -> None:
    refuses(frame().sort_values("angle").assign(episode="a"), DataError, "index goes from")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad: float) -> None:
    X = recording()
    X[17, 2] = bad
    refuses(X, DataError, f"contains NaN or inf: {bad} in row 17, column 'rate'")
    model = regressor().fit(recording())
    for method in (model.predict, model.predict_trajectory, model.score):
        with pytest.raises(DataError, match="row 17, column 'rate'"):
            method(X)
    rows, y = pairs()
    y[4, 1] = bad
    refuses(rows, DataError, "Target y contains NaN or inf: .* in row 4", y=y, episode_feature=False)


def test_a_function_that_is_not_defined_is_named() -> None:
    refuses(recording(), DataError, r"lifted X contains NaN or inf: nan in row \d+, column 'log\(angle\)'", functions=["log(angle)"])


def test_an_episode_of_one_sample_is_refused() -> None:
    refuses(recording((20, 1, 20)), DataError, r"Episode 1: found n_samples = 1 \(1 sample, row 20\), a transition needs at least 2")
    refuses(episode(1), DataError, "The only episode: found n_samples = 1", episode_feature=False)
    refuses(recording((2, 2)), DataError, "n_samples = 2 transitions for 4 unknowns")
    with pytest.raises(DataError, match="found 0 samples to compare with"):
        regressor(horizon=100).fit(recording()).score(recording())


def test_an_input_that_is_not_excited_is_named() -> None:
    X = recording()
    X[:, 3] = 0.0
    refuses(X, IdentificationError, "input 'u0' cannot be identified: it is zero throughout")
    regressor(alpha=1e-6).fit(X)


def test_dependent_functions_and_states_are_named() -> None:
    refuses(recording(), IdentificationError, r"lifted function '2\*angle' .* depends on the columns before it", functions=["2*angle"])
    trigonometric = ["sin(angle)**2", "cos(angle)**2", "cos(2*angle)"]
    refuses(recording(), IdentificationError, r"lifted function 'cos\(2\*angle\)'", functions=trigonometric)
    X = recording()
    X[:, 2] = -3 * X[:, 1]
    refuses(X, IdentificationError, "state 'rate' cannot be identified", functions=())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"functions": "sin(angle)"}, r"functions should be a list .* write \['sin\(angle\)'\]"),
        ({"states": "angle"}, "states should be a list"),
        ({"alpha": -1.0}, "alpha should be"),
        ({"alpha": np.nan}, "alpha should be"),
        ({"alpha": "1"}, "alpha should be"),
        ({"n_inputs": -1}, "n_inputs should be"),
        ({"n_inputs": 1.0}, "n_inputs should be"),
        ({"horizon": 0}, "horizon should be"),
        ({"functions": ["sin(angel)"]}, "unknown name 'angel'"),
        ({"functions": ["angle[-1]"]}, r"functions read angle\[-1\], but rows stand by themselves"),
        ({"functions": ["angle*u0"]}, "reads the present input u0"),
    ],
)
def test_parameters_that_are_not_valid_are_refused(options: dict[str, Any], message: str) -> None:
    refuses(recording(), ConfigError, message, **options)


def test_columns_that_do_not_add_up_are_refused() -> None:
    refuses(recording(), DataError, "3 columns .* n_inputs = 2 and states = ", n_inputs=2)
    refuses(recording(), DataError, "does not agree with n_inputs = 3", n_inputs=3, states=None)
    X, y = pairs()
    refuses(X, DataError, "y with 1 columns", y=y[:, 0], episode_feature=False)
    refuses(X, DataError, "147 rows and y has 100", y=y[:100], episode_feature=False)
    refuses(frame()[["voltage", "angle", "rate", "episode"]], DataError, "reorder it so that the states come first")
    refuses(frame()[["episode"]], DataError, "no state beside the episode")
    refuses(frame()[[*NAMES, "episode", "episode"]], DataError, "2 columns named 'episode'")
    refuses(recording()[0], DataError, "Expected 2D array")


@pytest.mark.filterwarnings("ignore:X .* feature names:UserWarning")
def test_rows_of_another_layout_than_in_fit_are_refused() -> None:
    model = KoopmanRegressor(FUNCTIONS, n_inputs=1).fit(frame())
    with pytest.raises(DataError, match=r"states and inputs \('angle', 'rate', 'voltage'\), found 4 columns"):
        model.predict(recording())
    arrays = KoopmanRegressor(n_inputs=1).fit(episode())
    with pytest.raises(DataError, match=r"found \('angle', 'voltage'\)"):
        arrays.predict(frame()[["episode", "angle", "voltage"]])


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
