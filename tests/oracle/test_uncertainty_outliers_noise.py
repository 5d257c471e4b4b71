"""Scores of units whose estimates are not equally good: static plants whose estimation errors are known by construction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kros.core.errors import DataError, DimensionError
from kros.uncertainty import Form, OutlierModel, score_outliers
from kros.uncertainty.outliers.score import Status

FREQS = np.geomspace(0.1, 100.0, 40)
SPREAD, NOISE, DRAWS = 0.02, 0.01, 30
SHAPE = (len(FREQS), 2, 1)


def plants(rng: np.random.Generator, count: int, spread: float = SPREAD) -> np.ndarray:
    """First-order lags whose gains and corners vary."""
    gain, corner = np.exp(spread * rng.normal(size=(2, count, 1, 2, 1)))
    return np.array([[1.0], [0.5]]) * gain / (1 + 1j * FREQS[:, None, None] / (10 * corner))


def errors(rng: np.random.Generator, size: float, *count: int) -> np.ndarray:
    """Estimation errors that change over frequency as responses of resampled models do: sums of a few lags."""
    lags = 1 / (1 + 1j * FREQS[:, None, None] / np.array([0.5, 5.0, 50.0])[:, None, None, None])
    return np.asarray(size * np.einsum("...kpm,kfpm->...fpm", rng.normal(size=(*count, 3, 2, 1)), np.broadcast_to(lags, (3, *SHAPE))))


def batch(rng: np.random.Generator, count: int = 12, times: tuple[float, ...] = ()) -> OutlierModel:
    """Score good units; the last ones have errors that are so many times as large."""
    sizes = NOISE * np.array([1.0] * (count - len(times)) + list(times))
    G = plants(rng, count) + np.stack([errors(rng, s) for s in sizes])
    return score_outliers(G, FREQS, deviations=[errors(rng, s, DRAWS) for s in sizes])


@pytest.mark.parametrize("form", [Form.ADDITIVE, Form.INVERSE_INPUT_MULTIPLICATIVE])
def test_without_further_noise_scores_are_those_of_responses_alone(form: Form) -> None:
    rng = np.random.default_rng(1)
    G = plants(rng, 10)
    plain = score_outliers(G, FREQS, form)
    known = score_outliers(G, FREQS, form, deviations=[errors(rng, NOISE, DRAWS)] * 10)
    assert known.scores == plain.scores


@pytest.mark.parametrize("times", [1.0, 3.0, 10.0])
def test_good_units_that_are_known_less_well_are_flagged_at_the_rate(times: float) -> None:
    """Twenty-four good units: at 0.3 percent more than one alarm has a probability of 0.24 percent."""
    alarms = told = 0
    for seed in range(6):
        rng = np.random.default_rng([2, seed])
        model = batch(rng)
        for G in plants(rng, 4):
            score = model.score("new", G + errors(rng, times * NOISE), errors(rng, times * NOISE, DRAWS))
            alarms += score.outlier
            told += score.status is Status.NOT_ENOUGH_DATA
    assert alarms <= 1
    if times == 10.0:
        assert told > 12


def test_the_same_units_are_flagged_where_nothing_is_known_about_their_noise() -> None:
    """The check can fail: with errors ten times as large nearly all stick out."""
    alarms = 0
    for seed in range(5):
        rng = np.random.default_rng([2, seed])
        model = batch(rng)
        alarms += sum(model.score("new", G + errors(rng, 10 * NOISE)).outlier for G in plants(rng, 4))
    assert alarms > 10


def test_bad_units_are_found_although_they_are_known_less_well() -> None:
    found = []
    for seed in range(4):
        rng = np.random.default_rng([3, seed])
        model = batch(rng)
        bad = 3 * plants(rng, 1)[0]
        found.append(model.score("bad", bad + errors(rng, 2 * NOISE), errors(rng, 2 * NOISE, DRAWS)).status)
    assert found.count(Status.OUTLIER) >= 3


def test_populations_of_unequal_recordings() -> None:
    """Four of twelve units have errors six times as large: none is flagged for that, and the others are compared without them."""
    alarms, silent = 0, 0
    for seed in range(4):
        model = batch(np.random.default_rng([4, seed]), times=(6.0,) * 4)
        alarms += sum(s.outlier for s in model.scores)
        silent += sum(s.status is Status.NOT_ENOUGH_DATA for s in model.scores[8:])
        assert set(model.unit_ids) <= {str(k) for k in range(8)}
        assert [s.unit for s in model.scores] == [str(k) for k in range(12)]
        assert all(s.outlier == (s.score_db > s.threshold_db) for s in model.scores)
    assert alarms <= 1
    assert silent > 8


def test_as_much_more_data_as_was_asked_for_is_enough() -> None:
    """Errors fall with the root of the data: with what was asked for, and a little more, the data are no longer what is missing."""
    rng = np.random.default_rng(5)
    model = batch(rng)
    G, draws = plants(rng, 1)[0], errors(rng, 10 * NOISE, DRAWS)
    short = model.score("short", G, draws)
    assert short.status is Status.NOT_ENOUGH_DATA
    assert 2 < short.more_data <= 150
    assert model.score("long", G, draws / np.sqrt(1.05 * short.more_data)).status is not Status.NOT_ENOUGH_DATA
    assert model.score("longer", G, draws / np.sqrt(short.more_data / 2)).status is Status.NOT_ENOUGH_DATA


def test_the_change_beside_a_score_is_what_would_have_been_flagged() -> None:
    """A unit in the middle of the others, with the named entry changed by clearly more than stated, is flagged; by clearly less, it is not."""
    rng = np.random.default_rng(6)
    model = batch(rng, 16)
    middle = np.median(model.responses.real, axis=0) + 1j * np.median(model.responses.imag, axis=0)
    middle = middle * model.output_scale[:, None] / model.input_scale
    score = model.score("ok", middle)
    assert score.status is Status.OK
    i, j = score.detectable_entry
    for factor, expected in ((0.5, False), (3.0, True)):
        changed = middle.copy()
        changed[:, i, j] *= 1 + factor * score.detectable_percent / 100
        assert model.score("changed", changed).outlier is expected


def test_few_units_tell_nothing(tmp_path: Path) -> None:
    for count in (3, 4):
        model = batch(np.random.default_rng(7), count)
        assert {s.status for s in model.scores} == {Status.CANNOT_TELL}
    model.save(tmp_path / "four")
    assert OutlierModel.load(tmp_path / "four").scores == model.scores
    three = batch(np.random.default_rng(8), 3)
    assert np.isinf(three.scores[0].detectable_percent)
    three.save(tmp_path / "three")
    assert OutlierModel.load(tmp_path / "three").score("new", three.responses[0]).status is Status.CANNOT_TELL


def test_a_unit_is_not_held_against_itself() -> None:
    rng = np.random.default_rng(9)
    G = plants(rng, 12)
    G[0] *= 1.05
    whole, others = score_outliers(G, FREQS), score_outliers(G[1:], FREQS, output_scale=[1.0, 1.0], input_scale=[1.0])
    itself = whole.score("0", G[0], without={"0"})
    assert itself.excess_db == pytest.approx(others.score("0", G[0]).excess_db, abs=1e-6)
    assert whole.score("0", G[0]).excess_db < itself.excess_db
    with pytest.raises(DataError, match="two are needed"):
        whole.score("0", G[0], without=whole.unit_ids[1:])


def test_deviations_that_do_not_fit_are_refused() -> None:
    rng = np.random.default_rng(10)
    G, draws = plants(rng, 5), errors(rng, NOISE, DRAWS)
    with pytest.raises(DataError, match="every unit"):
        score_outliers(G, FREQS, deviations=[draws] * 4)
    with pytest.raises(DimensionError, match="unit 2"):
        score_outliers(G, FREQS, deviations=[draws, draws, draws[:, :3], draws, draws])
    with pytest.raises(DimensionError, match="finite"):
        score_outliers(G, FREQS).score("new", G[0], draws * np.nan)
