"""Cross-validation against a slow implementation on whole data matrices, and against systems whose lifting is known."""

from __future__ import annotations

import numpy as np
import pytest

from kros.data import Channel, EpisodeKey, Population, Role, Unit
from kros.identify import LeaveOut, Selection, cross_validate
from kros.lifting import Lifting

CHANNELS = (Channel("a", Role.STATE), Channel("b", Role.STATE), Channel("u", Role.INPUT))
CANDIDATES = {
    "rich": Lifting(("a", "b"), ("sin(3*a + phase)", "a**2", "a*b", "cos(5*b)"), ("phase",)),
    "linear": Lifting(("a", "b")),
    "right": Lifting(("a", "b"), ("sin(3*a + phase)",), ("phase",)),
}
TRUE = np.array([[0.95, 0.10, 0.05, 0.0], [-0.15, 0.85, 0.20, 0.3]])


def population(n_units: int, n_episodes: int, n_samples: int, noise: float, seed: int = 0) -> tuple[Population, dict, np.ndarray]:
    """Units alike but for their phase and five percent in the second row; process noise, exact measurements."""
    rng = np.random.default_rng(seed)
    phase, data = rng.uniform(0, 6, n_units), {}
    for unit in range(n_units):
        W = TRUE * (1 + 0.05 * rng.normal(size=(2, 1)) * [[0], [1]])
        for episode in range(n_episodes + unit % 2):
            length = n_samples + 10 * episode
            u, x = rng.normal(size=(length, 1)), np.zeros((length, 2))
            x[0] = rng.normal(size=2)
            for k in range(length - 1):
                x[k + 1] = W @ [*x[k], np.sin(3 * x[k, 0] + phase[unit]), u[k, 0]] + noise * rng.normal(size=2)
            data[EpisodeKey(f"u{unit}", "default", str(episode))] = np.hstack([x, u])
    units = tuple(Unit(f"u{unit}") for unit in range(n_units))
    made = Population(CHANNELS, 0.01, units, tuple(data), data.__getitem__)
    return made, {unit.id: made.keys(unit.id) for unit in units}, phase


def by_hand(made: Population, keys: dict, phase: np.ndarray, leave_out: LeaveOut, folds: int, horizon: int | None) -> dict:
    """Percent of every candidate, alpha, fold, unit and state, from data matrices and loops over samples."""
    found = {}
    for name, lifting in CANDIDATES.items():
        for alpha in (0.0, 3.0):
            for fold in range(folds):
                for row, unit in enumerate(keys):
                    left_out = leave_out is LeaveOut.EPISODES
                    test = [k for i, k in enumerate(keys[unit]) if (i if left_out else row) % folds == fold]
                    train = [
                        (r, k)
                        for r, v in enumerate(keys)
                        for i, k in enumerate(keys[v])
                        if (r == row if left_out else True) and (i if left_out else r) % folds != fold
                    ]
                    if test:
                        W = ridge([(r, made.read(k)) for r, k in train], lifting, phase, alpha)
                        errors = [error_percent(W, lifting, phase[row], made.read(k), horizon) for k in test]
                        found[name, alpha, fold, unit] = np.mean(errors, axis=0)
    return found


def lift(lifting: Lifting, x: np.ndarray, phase: float) -> np.ndarray:
    return lifting.lift(x, {"phase": np.full(len(x), phase)} if lifting.parameters else {})


def ridge(data: list, lifting: Lifting, phase: np.ndarray, alpha: float) -> np.ndarray:
    now = np.vstack([np.hstack([lift(lifting, v[:-1, :2], phase[row]), v[:-1, 2:]]) for row, v in data])
    after = np.vstack([lift(lifting, v[1:, :2], phase[row]) for row, v in data])
    return np.linalg.solve(now.T @ now + alpha * np.eye(now.shape[1]), now.T @ after).T


def error_percent(W: np.ndarray, lifting: Lifting, phase: float, v: np.ndarray, horizon: int | None) -> np.ndarray:
    x, u = v[:, :2], v[:, 2:]
    errors = [np.zeros((1, 2))] if horizon is None else []
    for start in [0] if horizon is None else range(0, len(x) - horizon, 4):
        state = x[start : start + 1]
        for k in range(start, len(x) - 1 if horizon is None else start + horizon):
            state = (W @ np.concatenate([lift(lifting, state, phase)[0], u[k]]))[None, :2]
            if horizon is None or k == start + horizon - 1:
                errors.append(state - x[k + 1])
    return 100 * np.sqrt(np.mean(np.vstack(errors) ** 2, axis=0)) / np.abs(x).max(axis=0)


@pytest.mark.parametrize(("leave_out", "folds"), [(LeaveOut.EPISODES, 3), (LeaveOut.UNITS, 3), (LeaveOut.UNITS, 2)])
def test_equals_a_slow_implementation_on_data_matrices(leave_out: LeaveOut, folds: int) -> None:
    made, keys, phase = population(3, 3, 40, 0.02)
    found = cross_validate(made, keys, CANDIDATES, (0.0, 3.0), {"phase": phase}, leave_out, folds, (3, None), stride=4)
    for column, horizon in enumerate((3, None)):
        expected = by_hand(made, keys, phase, leave_out, folds, horizon)
        assert int(found.scored.sum()) * len(CANDIDATES) * 2 == len(expected)
        for (name, alpha, fold, unit), value in expected.items():
            at = (found.candidates.index(name), found.alphas.index(alpha), fold, found.unit_ids.index(unit), column)
            np.testing.assert_allclose(found.percent[at], value, rtol=1e-6)


@pytest.fixture(scope="module")
def clear() -> Selection:
    made, keys, phase = population(4, 6, 150, 0.02, seed=3)
    return cross_validate(made, keys, CANDIDATES, (0.0, 1.0, 1e3, 1e6), {"phase": phase}, horizons=(1, 10, None))


@pytest.mark.parametrize("horizon", [1, 10])
def test_the_lifting_that_made_the_data_is_chosen(clear: Selection, horizon: int) -> None:
    """The linear one cannot follow, the rich one fits noise; with the rule of one standard error the richer one never wins by luck."""
    choice = clear.best(horizon=horizon, one_standard_error=True)
    assert (choice.candidate, choice.alpha <= 1.0) == ("right", True)
    percent = clear.values("percent", horizon).mean(axis=(2, 3), where=clear.scored)
    linear, right = (percent[clear.candidates.index(name)].min() for name in ("linear", "right"))
    assert linear > 2 * right


def test_a_model_of_the_other_units_is_worse_than_an_own_one(clear: Selection) -> None:
    made, keys, phase = population(4, 6, 150, 0.02, seed=3)
    pooled = cross_validate(made, keys, CANDIDATES, (0.0,), {"phase": phase}, "units", horizons=(1, None))
    assert pooled.best(horizon=1).value > clear.best(horizon=1).value


def test_the_delay_that_made_the_data_is_chosen() -> None:
    """Second-order dynamics of one recorded state: without the earlier value they cannot be told, with a third one nothing is gained."""
    rng, data = np.random.default_rng(8), {}
    for episode in range(6):
        u, x = rng.normal(size=(200, 1)), np.zeros((200, 1))
        for k in range(1, 199):
            x[k + 1] = 1.5 * x[k] - 0.8 * x[k - 1] + u[k] + 0.05 * rng.normal()
        data[EpisodeKey("p", "default", str(episode))] = np.hstack([x, u])
    made = Population((Channel("x", Role.STATE), Channel("u", Role.INPUT)), 0.01, (Unit("p"),), tuple(data), data.__getitem__)
    candidates = {"none": Lifting(("x",)), "one": Lifting(("x",), ("x[-1]",)), "two": Lifting(("x",), ("x[-1]", "x[-2]"))}
    found = cross_validate(made, {"p": made.keys("p")}, candidates, (1e-6,), horizons=(1, 20), stride=2)
    assert found.best(horizon=1, one_standard_error=True).candidate == "one"
    percent = found.values("percent", 20)[:, 0].mean(axis=(1, 2))
    assert percent[0] > 2 * percent[1]
