"""The tail model against Monte Carlo and textbook order statistics, and outliers known by construction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from kros.uncertainty import Form, score_outliers
from kros.uncertainty.outliers.separation import excess, separate
from kros.uncertainty.outliers.tail import (
    SHAPE,
    exceedance,
    gumbel,
    leave_one_out_bounds,
    prediction_bound,
    prediction_factor,
)

FREQS = np.geomspace(0.1, 100.0, 60)


def test_l_moments_find_location_and_scale() -> None:
    location, scale = gumbel(stats.gumbel_r.rvs(3.0, 2.0, size=200_000, random_state=1))
    assert location == pytest.approx(3.0, abs=0.02)
    assert scale == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize(("count", "rate"), [(5, 0.05), (11, 0.01), (38, 0.003), (150, 0.003)])
def test_prediction_bound_is_exceeded_at_its_rate(count: int, rate: float) -> None:
    """Draws of another seed, other location and scale; four binomial standard deviations of the trials and 3 percent for the factor's own."""
    trials = 100_000 if count < 100 else 20_000
    draws = stats.genextreme.rvs(-SHAPE, -7.0, 3.0, size=(trials, count + 1), random_state=np.random.default_rng(77))
    share = (draws[:, -1] > prediction_bound(draws[:, :-1], rate)).mean()
    assert share == pytest.approx(rate, abs=4 * np.sqrt(rate / trials) + 0.03 * rate)


def test_factors_tend_to_the_quantile_of_the_distribution() -> None:
    many = stats.genextreme.rvs(-SHAPE, size=2_000_000, random_state=3)
    location, scale = gumbel(many)
    limit = (stats.genextreme.isf(0.003, -SHAPE) - location) / scale
    assert prediction_factor(10**7, 0.003) == pytest.approx(limit, rel=5e-3)
    np.testing.assert_allclose(exceedance(np.array([-20.0, -1.0, 0.0, 3.0])), stats.genextreme.sf([-20.0, -1.0, 0.0, 3.0], -SHAPE))
    assert prediction_factor(61, 0.003) == pytest.approx(prediction_factor(60, 0.003), rel=3e-3)


def test_leave_one_out_bounds_equal_those_of_the_others() -> None:
    scores = np.random.default_rng(2).gumbel(size=9)
    expected = [prediction_bound(np.delete(scores, k), 0.01) for k in range(9)]
    np.testing.assert_allclose(leave_one_out_bounds(scores, 0.01), expected, rtol=1e-12)
    assert np.isinf(leave_one_out_bounds(scores[:3], 0.01)).all()


def test_whole_search_flags_at_most_the_nominal_share_of_independent_scores() -> None:
    """Twelve units that each exceed at a frequency of their own, so that nobody's score depends on the others."""
    rng, flagged, trials = np.random.default_rng(5), 0, 1500
    for _ in range(trials):
        flagged += int((~separate(np.diag(stats.genextreme.rvs(-SHAPE, size=12, random_state=rng) + 30.0), 0.01).inliers).sum())
    share = flagged / (12 * trials)
    assert 0.005 <= share <= 0.01 + 4 * np.sqrt(0.01 / (12 * trials))


def test_excess_over_the_cover() -> None:
    levels = np.array([[0.0, 3.0], [2.0, 1.0], [-5.0, 2.0], [5.0, 2.5]])
    score, where = excess(levels)
    np.testing.assert_allclose(score, [0.5, -2.0, -1.0, 3.0])
    np.testing.assert_array_equal(where, [1, 1, 1, 0])


def test_reference_is_held_forty_decibels_below_its_peak() -> None:
    levels = np.array([[0.0, -100.0], [0.0, -100.0], [0.0, -50.0]])
    assert excess(levels)[0][2] == pytest.approx(0.0)


def population(scales: list[float], seed: int = 0) -> np.ndarray:
    """Static plants around one, with the deviation of each in units of the common spread."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(len(scales), 1, 2, 2))
    direction /= np.linalg.norm(direction, 2, axis=(2, 3), keepdims=True)
    nominal = np.array([[1.0, 0.3], [0.2, 1.0]]) / (1 + 1j * FREQS[:, None, None] / 10)
    return nominal * (1 + 0.02 * np.array(scales)[:, None, None, None] * direction)


GOOD = [1.0, 0.8, 1.1, 0.9, 1.2, 0.7, 1.05, 0.95, 0.85, 1.15, 0.75]


@pytest.mark.parametrize("form", list(Form))
def test_a_gross_outlier_is_found_in_every_form_and_with_every_nominal(form: Form) -> None:
    model = score_outliers(population([*GOOD, 25.0]), FREQS, form)
    assert model.scores[-1].outlier
    assert int(np.argmax([s.score_db for s in model.scores])) == 11
    assert model.scores[-1].agreement > 0.5
    assert model.scores[-1].lowest_db > 10  # beyond the cover of the others whatever the nominal, as the paper has it
    assert all(s.agreement <= 0.5 for s in model.scores[:-1])


def test_units_that_differ_in_nothing_but_gain_are_flagged_at_the_rate() -> None:
    """All their scores come from one and the same frequency."""
    rng, flagged, found = np.random.default_rng(21), 0, 0
    for _ in range(100):
        gains = np.append(1 + 0.02 * rng.normal(size=20), 1.5)
        outliers = [s.outlier for s in score_outliers((gains[:, None] / (1 + 1j * FREQS / 5))[:, :, None, None], FREQS).scores]
        flagged, found = flagged + sum(outliers[:-1]), found + outliers[-1]
    assert found == 100
    assert flagged <= stats.binom.ppf(0.999, 2000, 0.003)


def test_the_entry_and_frequency_where_a_unit_sticks_out() -> None:
    """Unit 11 has a resonance of its own at 5 Hz in the entry (1, 0)."""
    G = population([*GOOD, 1.0])
    G[11, :, 1, 0] += 2.0 / (1 + 1j * 40 * np.log(FREQS / 5.0))
    model = score_outliers(G, FREQS, output_scale=[1.0, 1.0], input_scale=[1.0, 1.0])
    found = model.scores[11]
    assert found.outlier
    assert found.entry == (1, 0)
    assert abs(np.log10(found.freq_hz / 5.0)) < 0.2


@pytest.mark.parametrize("form", list(Form))
def test_excess_with_one_nominal_is_that_of_its_residuals(form: Form) -> None:
    """Diagonal plants, one frequency-independent entry: the residual's magnitude by hand, in dB over the largest of the others."""
    gains = np.array([1.0, 1.1, 0.95, 1.05, 2.0])
    G = gains[:, None, None, None] * np.ones((5, 60, 1, 1))
    model = score_outliers(G, FREQS, form)
    by_hand = {
        Form.ADDITIVE: lambda g, p: p - g,
        Form.INPUT_MULTIPLICATIVE: lambda g, p: (p - g) / g,
        Form.OUTPUT_MULTIPLICATIVE: lambda g, p: (p - g) / g,
        Form.INVERSE_ADDITIVE: lambda g, p: (p - g) / (p * g),
        Form.INVERSE_INPUT_MULTIPLICATIVE: lambda g, p: (p - g) / p,
        Form.INVERSE_OUTPUT_MULTIPLICATIVE: lambda g, p: (p - g) / p,
    }[form]
    inliers = [int(u) for u in model.unit_ids]
    for k in range(4):
        E = 20 * np.log10(np.abs(by_hand(gains[k], np.delete(gains, k))))
        if len(inliers) == 4:
            assert model.by_nominal_db[k, 4] == pytest.approx(E[-1] - E[:-1].max(), abs=1e-9)
    score = model.scores[4]
    assert score.lowest_db == pytest.approx(np.nanmin(model.by_nominal_db[:, 4]))
    assert score.highest_db == pytest.approx(np.nanmax(model.by_nominal_db[:, 4]))
    assert np.isnan(model.by_nominal_db[4, 4])
