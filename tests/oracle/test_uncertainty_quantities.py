"""Single quantities of units against populations with known truth: rates, leakages, covariates."""

import numpy as np
import pytest
from scipy import stats

from kros.identify.static_gains import static_gains
from kros.uncertainty.outliers.quantities import Quantities, Status, score_quantities

RATE = 0.003


def table(values, temperature=None, deviations=None):
    values = np.atleast_2d(np.asarray(values, dtype=float))
    ids, names = tuple(f"u{k}" for k in range(len(values))), tuple(f"q{k}" for k in range(values.shape[1]))
    known = np.zeros(values.shape) if deviations is None else np.broadcast_to(deviations, values.shape)
    beside = {} if temperature is None else {"temperature": np.atleast_1d(np.asarray(temperature, dtype=float))}
    return Quantities(ids, names, values, known, np.zeros(values.shape[1]), beside)


DRAWS = {
    "normal": lambda rng, size: rng.normal(size=size),
    "of one sign": lambda rng, size: rng.exponential(size=size),
    "heavy": lambda rng, size: rng.standard_t(4, size=size),
}


@pytest.mark.parametrize("kind", DRAWS)
@pytest.mark.parametrize(("units", "quantities", "covariate"), [(8, 1, False), (12, 6, True), (20, 1, False), (30, 4, True)])
def test_good_units_are_flagged_at_most_at_the_rate(kind, units, quantities, covariate):
    """Of heavy tails, which the model does not know, at most five times the rate."""
    rng, count, rate = np.random.default_rng(5), 300, 0.02
    flagged = told = 0
    for _ in range(count):
        T = rng.uniform(20, 40, units + 1)
        q = 1 + 0.02 * DRAWS[kind](rng, (units + 1, quantities)) + 0.01 * covariate * T[:, None]
        found = score_quantities(*(table(q[part], T[part] if covariate else None) for part in (slice(units), slice(units, None))), rate)
        told, flagged = told + (found.status is not Status.CANNOT_TELL), flagged + found.outlier
    assert told > 0.85 * count
    assert flagged <= stats.binom.ppf(0.999, told, rate if kind == "normal" else 5 * rate)


def test_the_deviation_is_that_of_a_regression_without_the_unit():
    """The new unit's score is the textbook's prediction error; those of the population are found by leaving each out."""
    rng = np.random.default_rng(1)
    T = rng.uniform(20, 40, 15)
    q = 1 + 0.01 * T + 0.02 * rng.normal(size=15)
    found = score_quantities(table(q[:-1, None], T[:-1]), table(q[-1:, None], T[-1:]), RATE)
    X = np.column_stack([np.ones(14), T[:-1]])
    b, rss, *_ = np.linalg.lstsq(X, q[:-1], rcond=None)
    x = np.array([1.0, T[-1]])
    deviation = np.sqrt(rss[0] / 12 * (1 + x @ np.linalg.inv(X.T @ X) @ x))
    assert found.expected == pytest.approx(x @ b)
    assert found.deviation == pytest.approx(deviation)
    assert found.score == pytest.approx(abs(q[-1] - x @ b) / deviation)


def test_a_leakage_is_found_also_beside_one_of_the_population():
    rng, found, masked = np.random.default_rng(2), 0, 0
    for _ in range(100):
        gains = 1 + 0.015 * rng.normal(size=(20, 1))
        found += score_quantities(table(gains), table([[0.85]]), RATE).outlier
        gains[0] = 0.8
        masked += score_quantities(table(gains), table([[0.85]]), RATE).outlier
    assert found >= 95
    assert masked >= 90


def test_what_a_temperature_does_is_no_defect_where_it_was_recorded():
    rng = np.random.default_rng(3)
    T = rng.uniform(20, 25, 20)
    T[:2] = 20.0, 40.0  # one of them warm
    gains = (1 + 0.02 * (T - 22) + 0.005 * rng.normal(size=20))[:, None]
    warm = [[1 + 0.02 * (38 - 22)]]
    assert score_quantities(table(gains[2:]), table(warm), RATE).outlier
    told = score_quantities(table(gains, T), table(warm, 38.0), RATE)
    assert (told.status, told.covariates) == (Status.OK, ("temperature",))
    assert score_quantities(table(gains, T), table([[1.0]], 38.0), RATE).outlier  # a leakage that the warmth would hide
    beyond = score_quantities(table(gains[2:], T[2:]), table(warm, 38.0), RATE)
    assert (beyond.status, beyond.score) == (Status.CANNOT_TELL, None)
    assert "temperature is 38, and the units cover 2" in beyond.reason
    silent = score_quantities(table(gains, T), table([[1.0]]), RATE)
    assert silent.reason == "temperature was not recorded of the unit"


def test_a_covariate_that_never_changes_is_held_against_the_units_too():
    gains = 1 + 0.01 * np.random.default_rng(4).normal(size=(12, 1))
    same = np.full(12, 24.0)
    found = score_quantities(table(gains, same), table([[1.0]], 24.0), RATE)
    assert (found.status, found.covariates) == (Status.OK, ())
    assert "the units cover 24 to 24" in score_quantities(table(gains, same), table([[1.0]], 26.0), RATE).reason


def test_few_units_tell_nothing():
    gains = 1 + 0.01 * np.random.default_rng(4).normal(size=(8, 1))
    assert score_quantities(table(gains), table([[2.0]]), RATE).outlier
    few = score_quantities(table(gains), table([[2.0]]), RATE, without=("u3",))
    assert (few.status, few.reason) == (Status.CANNOT_TELL, "too few units to tell: 7 of 8")
    unknown = score_quantities(table(gains), table([[np.nan]]), RATE)
    assert unknown.status is Status.CANNOT_TELL


def test_what_is_not_known_of_a_unit_makes_it_no_outlier():
    gains = 1 + 0.01 * np.random.default_rng(4).normal(size=(20, 1))
    assert score_quantities(table(gains), table([[1.15]]), RATE).outlier
    assert not score_quantities(table(gains), table([[1.15]], deviations=0.1), RATE).outlier


def motion(gain, rng, count=3000, noise=1e-3):
    """Two inputs; the second state follows the first one slowly, and with a leakage."""
    u = np.repeat(rng.uniform(-1, 1, (12, 2)), count // 12, axis=0)
    x = np.zeros((count, 2))
    for k in range(count - 1):
        x[k + 1] = x[k] + 0.2 * (np.array([u[k, 0] + 0.3 * u[k, 1], gain * u[k, 1]]) - x[k])
    return x + noise * rng.normal(size=x.shape), u


def test_static_gains_of_a_known_machine():
    rng = np.random.default_rng(6)
    runs = [motion(0.85, rng) for _ in range(3)]
    found = static_gains([x for x, _ in runs], [u for _, u in runs], 250, np.ones(2))
    truth = np.array([[1.0, 0.3], [0.0, 0.85]])
    assert np.abs(found.gains - truth).max() < 1e-3
    assert (np.abs(found.gains - truth) < 5 * found.deviations).all()
    assert (found.explained > 0.999).all()


def test_an_angle_has_no_gain_from_its_rate():
    """What it takes to move at a constant rate is the gain of the current."""
    rng = np.random.default_rng(8)
    rate = np.repeat(rng.uniform(-1, 1, 24), 125)
    angle = np.concatenate([[0.0], np.cumsum(rate[:-1])])
    states = np.column_stack([angle, 0.3 * rate]) + 1e-4 * rng.normal(size=(3000, 2))
    found = static_gains([states], [rate[:, None]], 250, np.ones(1))
    assert found.gains[1, 0] == pytest.approx(0.3, abs=1e-3)
    assert found.explained[0] < 0.5


def test_gains_that_the_motion_does_not_tell_are_not_known():
    rng = np.random.default_rng(7)
    x, u = motion(0.85, rng)
    held = np.column_stack([u[:, 0], np.full(len(u), 0.4)])
    assert np.isnan(static_gains([x], [held], 250, np.ones(2)).gains[:, 1]).all()
    twice = np.column_stack([u[:, 0], 2 * u[:, 0]])
    assert np.isnan(static_gains([x], [twice], 250, np.ones(2)).gains).all()
    assert static_gains([x[:600]], [u[:600]], 250, np.ones(2)).blocks == 2
    x[100] = np.nan
    assert static_gains([x], [u], 250, np.ones(2)).blocks == 11
    assert np.isfinite(static_gains([x], [u], 250, np.ones(2)).gains).all()
