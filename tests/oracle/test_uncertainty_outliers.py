"""The bound of one further unit against draws and by hand, rates over populations of several kinds, and outliers known by construction."""

from __future__ import annotations

import numpy as np
import pytest
from forms import residual_of
from scipy import stats

from kros.uncertainty import Form, score_outliers
from kros.uncertainty.outliers.score import FEWEST_UNITS, Status
from kros.uncertainty.outliers.tail import factor, margins, prediction_bound, scale, separate

FREQS = np.geomspace(0.1, 100.0, 60)


@pytest.mark.parametrize(("count", "rate"), [(5, 0.05), (11, 0.01), (38, 0.003), (150, 0.003)])
def test_prediction_bound_is_exceeded_at_its_rate(count: int, rate: float) -> None:
    """Exponential draws of some location and scale; four binomial standard deviations of the trials."""
    trials = 200_000
    draws = -7.0 + 3.0 * np.random.default_rng(77).exponential(size=(trials, count + 1))
    share = (draws[:, -1] > prediction_bound(draws[:, :-1], rate)).mean()
    assert share == pytest.approx(rate, abs=4 * np.sqrt(rate / trials))


@pytest.mark.parametrize(
    "draw",
    [np.random.Generator.standard_normal, np.random.Generator.random, lambda g, s: np.sqrt(g.exponential(size=s))],
)
def test_lighter_tails_exceed_the_bound_less_often(draw) -> None:
    draws = draw(np.random.default_rng(3), (100_000, 12))
    assert (draws[:, -1] > prediction_bound(draws[:, :-1], 0.01)).mean() < 0.01


def test_the_bound_of_a_unit_is_that_of_the_others() -> None:
    for n in (3, 4, 9, 12):
        levels = np.random.default_rng(n).integers(0, 6, size=(n, 5)).astype(float)  # ties among them
        expected = [factor(n - 1, 0.01) * scale(np.delete(levels, k, axis=0)).mean() for k in range(n)]
        value, beyond = margins(levels, np.ones(n, bool), 0.01)
        np.testing.assert_allclose(value - beyond, np.maximum(expected, 1e-8), atol=1e-12)
    assert scale(np.array([1.0, 9.0, 4.0, 2.0])) == pytest.approx((2 * (9 - 4) + 3 * (4 - 2) + 4 * (2 - 1)) / 3)
    assert factor(11, 0.003) == pytest.approx(10 * ((0.003 * 12) ** (-1 / 10) - 1))
    assert factor(1000, 0.003) == 0.0
    assert np.isinf(prediction_bound(np.ones(2), 0.01))


def test_excess_is_over_the_largest_of_the_other_inliers() -> None:
    levels = np.array([[0.0, 3.0], [2.0, 1.0], [-5.0, 2.0], [5.0, 2.5], [9.0, 0.0]])
    inliers = np.array([True, True, True, True, False])
    value, beyond = margins(levels, inliers, 0.01)
    np.testing.assert_allclose(value, [-2.0, -3.0, -3.0, 2.0, 4.0])
    bound = factor(3, 0.01) * np.mean([scale(levels[[0, 1, 2], f]) for f in range(2)])
    assert beyond[3] == pytest.approx(2.0 - bound)


def test_the_whole_search_flags_at_most_the_nominal_share() -> None:
    """Exponential levels of one frequency: the steps together, and at most a third of the units."""
    rng, flagged, trials, rate = np.random.default_rng(5), 0, 1000, 0.01
    for _ in range(trials):
        flagged += int((~separate(rng.exponential(size=(12, 1)), rate).inliers).sum())
    assert flagged / (12 * trials) <= rate + 4 * np.sqrt(rate / (12 * trials))
    levels = np.concatenate([np.zeros((8, 1)), 1e2 ** np.arange(1.0, 9.0)[:, None]])
    assert (~separate(levels, rate).inliers).sum() == 5


SPREADS = {
    "normal": lambda rng, n: rng.normal(size=(5, n)),
    "log-normal": lambda rng, n: (np.exp(rng.normal(size=(5, n))) - 1.6) / 2.1,
    "two suppliers": lambda rng, n: rng.choice([-1, 1], (5, n)) + 0.15 * rng.normal(size=(5, n)),
    "two suppliers of everything": lambda rng, n: rng.choice([-1, 1], n) + 0.15 * rng.normal(size=(5, n)),
}


def resonant(deviations: np.ndarray) -> np.ndarray:
    """A lag and a resonance of which five parameters deviate, shape (unit, frequency, 2, 1)."""
    k, tau, z, w, g = np.exp(0.08 * deviations)[:, :, None]
    s = 2j * np.pi * np.geomspace(0.01, 50, 60)
    return np.stack([k / (1 + 0.3 * tau * s), g * (6 * w) ** 2 / (s**2 + 1.8 * z * w * s + (6 * w) ** 2)], axis=-1)[
        ..., None
    ]


@pytest.mark.parametrize("kind", list(SPREADS))
def test_good_units_of_every_kind_of_population_are_rarely_flagged_or_undecided(kind: str) -> None:
    """A hundred populations of twelve: at most 1 % of good units flagged, within what chance allows, and 10 % undecided."""
    rng, found = np.random.default_rng(11), []
    for _ in range(100):
        found += [s.status for s in score_outliers(resonant(SPREADS[kind](rng, 12)), np.geomspace(0.01, 50, 60)).scores]
    assert found.count(Status.OUTLIER) <= stats.binom.ppf(0.99, len(found), 0.01)
    assert found.count(Status.CANNOT_TELL) <= 0.1 * len(found)


@pytest.mark.parametrize("count", [3, FEWEST_UNITS - 1])
def test_fewer_than_eight_units_decide_nothing(count: int) -> None:
    """A unit with ten times the gain of the others is not flagged, and no other unit is ok."""
    G = resonant(np.random.default_rng(1).normal(size=(5, count)))
    G[0] *= 10
    model = score_outliers(G, np.geomspace(0.01, 50, 60))
    assert {s.status for s in model.scores} == {Status.CANNOT_TELL}
    assert model.score("new", 10 * G[1]).status is Status.CANNOT_TELL
    more = score_outliers(
        np.concatenate([G, resonant(np.random.default_rng(2).normal(size=(5, 5)))]), np.geomspace(0.01, 50, 60)
    )
    assert [s.outlier for s in more.scores][:2] == [True, False]


@pytest.mark.parametrize("spread", [1, 4, 8, 20])
def test_the_fewest_units_that_would_decide_are_those_from_which_on_units_are_decided(spread: int) -> None:
    """A unit like the others is decided on where its study has as many, and never where no number would."""
    rng, found = np.random.default_rng(spread), []
    for count in (FEWEST_UNITS - 1, FEWEST_UNITS, 12, 20) * 5:
        model = score_outliers(resonant(spread * rng.normal(size=(5, count))), np.geomspace(0.01, 50, 60))
        score = model.score("new", resonant(spread * rng.normal(size=(5, 1)))[0])
        if score.status is not Status.OUTLIER:
            enough = score.fewest_units is not None and score.fewest_units <= len(model.unit_ids)
            assert (score.status is Status.OK) == enough
            found.append(score.fewest_units)
    assert all(n is None or n >= FEWEST_UNITS for n in found)
    assert spread > 1 or set(found) == {FEWEST_UNITS}
    assert spread < 20 or None in found


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
    assert model.scores[-1].lowest_db > 10  # beyond the cover of the others whatever the nominal, as the paper has it


@pytest.mark.parametrize("form", list(Form))
def test_excess_with_one_nominal_is_that_of_its_residuals(form: Form) -> None:
    """Plants of one frequency-independent entry: the magnitude of the residual, in dB over the largest of the others."""
    gains = np.array([1.0, 1.1, 0.95, 1.05, 2.0])
    G = gains[:, None, None, None] * np.ones((5, 60, 1, 1))
    model = score_outliers(G, FREQS, form)
    E = [20 * np.log10(np.abs(residual_of(form, G[k, 0], np.delete(G, k, axis=0)[:, 0]).ravel())) for k in range(4)]
    excess = [e[-1] - e[:-1].max() for e in E]
    assert model.scores[4].lowest_db == pytest.approx(min(excess), abs=1e-9)
    assert model.scores[4].highest_db == pytest.approx(max(excess), abs=1e-9)
