"""Edges of cross-validation: folds, missing things, failed fits, and the rules of choice."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from kros.core import ConfigError, DataError, IdentificationError
from kros.data import OUTLIERS, Channel, EpisodeKey, Population, Role, Unit
from kros.identify import Factor, LeaveOut, Selection, combine, cross_validate, episode_factors, lifted_factor, reduce_episode
from kros.lifting import Lifting

CHANNELS = (Channel("a", Role.STATE), Channel("b", Role.STATE), Channel("u", Role.INPUT))
LINEAR = Lifting(("a", "b"))


def population(lengths: dict[str, list[int]], outliers: tuple[str, ...] = ()) -> tuple[Population, dict]:
    data = {}
    for unit, own in lengths.items():
        for episode, length in enumerate(own):
            rng = np.random.default_rng([len(data), 7])
            u, x = rng.normal(size=(length, 1)), rng.normal(size=(length, 2))
            for k in range(length - 1):
                x[k + 1] = [0.9 * x[k, 0] + u[k, 0], 0.5 * x[k, 1]] + 0.1 * rng.normal(size=2)
            data[EpisodeKey(unit, "default", str(episode))] = np.hstack([x, u])
    units = tuple(Unit(unit, OUTLIERS if unit in outliers else "") for unit in lengths)
    made = Population(CHANNELS, 0.01, units, tuple(data), data.__getitem__)
    return made, {unit: made.keys(unit) for unit in lengths}


def test_folds_hold_whole_episodes_and_every_episode_once() -> None:
    made, keys = population({"p": [30] * 5, "q": [30] * 2})
    found = cross_validate(made, keys, {"linear": LINEAR}, (0.0,), folds=3, horizons=(1,))
    np.testing.assert_array_equal(found.scored, [[True, True], [True, True], [True, False]])
    assert np.isnan(found.percent[0, 0, 2, 1]).all()
    assert len(found.as_rows()) == 5 * 2
    assert {(row["fold"], row["unit"]) for row in found.as_rows()} == {(0, "p"), (1, "p"), (2, "p"), (0, "q"), (1, "q")}


def test_the_same_request_gives_the_same_table_whatever_memory_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    made, keys = population({"p": [30] * 4, "q": [40] * 3})
    request = (made, keys, {"linear": LINEAR, "square": Lifting(("a", "b"), ("a**2",))}, (0.0, 1.0))
    first = cross_validate(*request, horizons=(1, 5, None))
    monkeypatch.setattr("kros.identify.cross_validation._AT_ONCE", 1)
    second = cross_validate(*request, horizons=(1, 5, None))
    assert first.as_rows() == second.as_rows()
    assert len(first.as_rows()) == 2 * 2 * 7 * 3 * 2


def test_outliers_take_no_part(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    made, keys = population({"p": [30] * 2, "bad": [30] * 2, "q": [30] * 2}, outliers=("bad",))
    found = cross_validate(made, keys, {"linear": LINEAR}, (0.0,), leave_out="units", horizons=(1,))
    assert found.unit_ids == ("p", "q")
    assert "bad" in caplog.text


def test_a_pair_without_a_model_scores_infinity_and_is_not_chosen(caplog: pytest.LogCaptureFixture) -> None:
    made, keys = population({"p": [30] * 3})
    double = Lifting(("a", "b"), ("2*a",))
    found = cross_validate(made, keys, {"double": double}, (0.0, 1e-3), horizons=(1, None))
    assert np.isinf(found.percent[0, 0][found.scored]).all()
    assert np.isnan(found.spectral_radius[0, 0][found.scored]).all()
    assert found.best().alpha == 1e-3
    assert "depends on the others" in caplog.text


def test_what_is_missing_is_named() -> None:
    made, keys = population({"p": [30] * 3, "q": [30]})
    with pytest.raises(DataError, match="unit q has 1 training episodes"):
        cross_validate(made, keys, {"linear": LINEAR}, (0.0,))
    with pytest.raises(DataError, match=r"long enough for horizons \[100\]"):
        cross_validate(made, {"p": keys["p"]}, {"linear": LINEAR}, (0.0,))
    with pytest.raises(DataError, match="leaves none to fit"):
        cross_validate(made, {"p": keys["p"]}, {"linear": LINEAR}, (0.0,), leave_out="units")
    with pytest.raises(ConfigError, match="'sine' needs 'phase'"):
        cross_validate(made, keys, {"sine": Lifting(("a", "b"), ("sin(a + phase)",), ("phase",))}, (0.0,))
    with pytest.raises(ConfigError, match="episodes, units"):
        cross_validate(made, keys, {"linear": LINEAR}, (0.0,), leave_out="samples")
    for wrong in ({"alphas": (-1.0,)}, {"candidates": {}}, {"folds": 1}):
        with pytest.raises(ConfigError, match="at least two folds"):
            cross_validate(made, keys, **{"candidates": {"linear": LINEAR}, "alphas": (0.0,), **wrong})


def table(percent: list) -> Selection:
    """Candidates "big" (4 lifted states) and "small" (2), alphas 0 and 1, one fold, some units, one state."""
    values = np.array(percent, dtype=float)[:, :, None, :, None, None]
    scored = np.ones((1, values.shape[3]), dtype=bool)
    ids = tuple(f"u{i}" for i in range(values.shape[3]))
    return Selection(
        LeaveOut.EPISODES, ("big", "small"), (4, 2), (0.0, 1.0), ids, ("a",), (None,), scored, values, values, 1 - values, values[..., 0, 0]
    )


def test_the_rule_of_one_standard_error_takes_the_simplest_that_is_as_good() -> None:
    """Smallest mean 2 with a standard error of 1: small at alpha 1 has 2.9, small at alpha 0 has 2.5."""
    rows = table([[[1, 3], [9, 9]], [[2.5, 2.5], [2.9, 2.9]]])
    plain, simple = rows.best(), rows.best(one_standard_error=True)
    assert (plain.candidate, plain.alpha, plain.value, plain.standard_error) == ("big", 0.0, 2.0, pytest.approx(1.0))
    assert (simple.candidate, simple.alpha, simple.value, simple.best_value) == ("small", 1.0, 2.9, 2.0)
    assert rows.best(measure="r2", one_standard_error=True).candidate == "small"
    assert rows.best(units="worst").candidate == "small"


def test_equal_losses_go_to_the_simpler() -> None:
    choice = table([[[1, 1], [1, 1]], [[1, 1], [1, 1]]]).best()
    assert (choice.candidate, choice.alpha) == ("small", 1.0)


def test_runs_that_diverge_on_one_unit_are_not_chosen_by_the_mean() -> None:
    assert table([[[1, np.inf], [5, 5]], [[6, 6], [7, 7]]]).best().value == 5.0
    with pytest.raises(IdentificationError, match="no candidate"):
        table([[[np.inf] * 2] * 2] * 2).best()


def test_criteria_that_do_not_exist_are_refused() -> None:
    rows = table([[[1, 1], [1, 1]], [[1, 1], [1, 1]]])
    for wrong in ({"measure": "mae"}, {"horizon": 3}, {"units": "best"}, {"units": "worst", "one_standard_error": True}):
        with pytest.raises(ConfigError, match="Selection"):
            rows.best(**wrong)
    assert replace(rows, horizons=(3,)).best(horizon=3).value == 1.0


def test_factors_by_episode_combine_to_those_of_the_unit() -> None:
    """A function with a factor and a phase, so that the parameter-free basis is not the lifting itself."""
    made, keys = population({"p": [30] * 3, "q": [40] * 2})
    lifting, phase = Lifting(("a", "b"), ("2*sin(a + phase)",), ("phase",)), np.array([0.3, 1.1])
    found = episode_factors(made, keys, lifting, {"phase": phase})
    assert found.n_samples.tolist() == [[29, 29, 29], [39, 39, 0]]
    assert not found.R[1, 2].any()
    for row, own in enumerate(keys.values()):
        each = [reduce_episode(*made.read_parts(key), lifting) for key in own]
        free = combine(Factor(*(np.stack([getattr(f, name) for f in each])[None] for name in ("R", "peak", "n_samples"))))
        expected = lifted_factor(free, lifting, {"phase": phase[[row]]}, lifting).R[0]
        R = combine(found).R[row]
        np.testing.assert_allclose(R.T @ R, expected.T @ expected, rtol=1e-9, atol=1e-9)
    with pytest.raises(DataError, match="without an episode"):
        episode_factors(made, {"p": ()}, lifting, {"phase": phase})
