"""The monitor: one machine against batches computed otherwise, band powers against their integrals, and the bound of a population against one by hand."""

from dataclasses import replace

import numpy as np
import pytest
from machines import DT, LIMITS, MACHINES, drive, filters, in_python, samples, watched

from kros.core.errors import DataError, DimensionError
from kros.core.lti import gain
from kros.design.monitor import MonitorSettings, bound_of_peaks, fit_monitor
from kros.design.training import TrainingSet
from kros.lifting import Lifting
from kros.observer import Observer, SampleStatus
from kros.observer.monitor import RECOVERY, Monitor, Watch, octaves
from kros.observer.simulate import Course, run_innovations
from kros.observer.units import in_sizes
from kros.plants import HarmonicDrivePopulation
from kros.synthesis import Injection
from kros.uncertainty.outliers.tail import prediction_bound


def levels(observer, y, u):
    running = observer.start(y[0])
    found, status = [], []
    for sample in zip(y, u, strict=True):
        running.step(*sample)
        found.append(running.level_db)
        status.append(int(running.status))
    return np.array(found), np.array(status)


@pytest.mark.parametrize(("machine", "bound"), [(drive(), 1.0), (drive(delay=2, **LIMITS), 1.0), (filters(), 0.03)])
def test_one_machine_is_watched_as_many_at_once(machine, bound):
    observer, (y, u) = watched(machine, bound), samples(800)
    found, status = levels(observer, y, u)
    innovation, judged = run_innovations(observer, y[:, None], u[:, None], settle=observer.monitor.settle)
    wanted = observer.monitor.level(Watch(observer.monitor).mean_squares(innovation[:, 0], judged[:, 0]))
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    outside = (status & SampleStatus.UNCERTIFIED) > 0
    np.testing.assert_array_equal(outside, wanted > 0)
    assert 0.05 < outside.mean() < 0.95
    course = Course(observer, watched=True)
    blocks = [course.take(y[part, None], u[part, None]).status[:, 0] for part in (slice(300), slice(300, None))]
    np.testing.assert_array_equal(np.concatenate(blocks), status)


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("kind", MACHINES)
def test_blocks_and_single_samples_have_the_same_status(kind, lost):
    """Compiled where no start comes again, else step by step."""
    observer, (y, u) = MACHINES[kind](), samples(700 if "monitor" in kind else 350, faults=lost)
    course, blocks = Course(observer, watched=True), [slice(k, k + 175) for k in range(0, len(y), 175)]
    found = np.concatenate([course.take(y[block, None], u[block, None]).status[:, 0] for block in blocks])
    np.testing.assert_array_equal(found, in_python(observer, y, u)[1])
    assert bool(found.any()) == (lost or "limits" in kind or "monitor" in kind)


def test_bands_pass_the_power_that_their_filters_say():
    filters, rng = octaves(), np.random.default_rng(0)
    w = np.linspace(0, np.pi, 200_001)
    z = np.exp(-1j * w)
    response = np.array([b * (1 - z**2) / (1 + a1 * z + a2 * z**2) for b, a1, a2 in filters])
    np.testing.assert_allclose(w[np.abs(response).argmax(axis=1)] / (2 * np.pi), 0.256 / 2.0 ** np.arange(6), atol=1e-5)
    np.testing.assert_allclose(np.abs(response).max(axis=1), 1, rtol=1e-6)
    noise = rng.normal(size=(400_000, 1))
    monitor = Monitor(filters, 1e-5, 0, np.ones(1), np.ones((1, 6)), np.array([[16, 0, 0, 0, 0, 0]]), 0.02)
    powers = Watch(monitor).mean_squares(noise, np.ones(400_000, dtype=bool))[-1, 0]
    np.testing.assert_allclose(powers, np.mean(np.abs(response) ** 2, axis=1) * (1 - (1 - 1e-5) ** 400_000), rtol=0.05)


def test_in_the_beginning_mean_squares_are_means():
    """Against the mean of what was, with ten quiet samples before it; from a hundred on as an exponential mean."""
    filters, rng = octaves(), np.random.default_rng(4)
    monitor = Monitor(filters, 0.01, 0, np.ones(1), np.ones((1, 6)), np.array([[16, 0, 0, 0, 0, 0]]), 0.02, first=0.1)
    noise, judged = rng.normal(size=(500, 1)), np.ones(500, dtype=bool)
    squares = Watch(replace(monitor, forget=1.0, first=0.0)).mean_squares(noise, judged)[:, 0]
    found = Watch(monitor).mean_squares(noise, judged)[:, 0]
    np.testing.assert_allclose(found[:91], np.cumsum(squares, axis=0)[:91] / (10 + np.arange(91))[:, None], rtol=1e-12)
    np.testing.assert_allclose(found[91:], 0.99 * found[90:-1] + 0.01 * squares[91:], rtol=1e-9)
    halves = [(noise[:200], judged[:200]), (noise[200:], judged[200:])]
    np.testing.assert_array_equal(np.concatenate(monitor.in_turn(halves))[:, 0], found)


def test_what_is_missing_holds_the_monitor_and_a_reset_clears_it():
    observer, (y, u) = watched(drive()), samples(400, faults=False)
    before, _ = levels(observer, y, u)
    y[300:303] = np.nan
    found, _ = levels(observer, y, u)
    np.testing.assert_array_equal(found[:300], before[:300])
    np.testing.assert_array_equal(found[300 : 303 + 3 * RECOVERY], found[299])
    assert found[303 + 3 * RECOVERY] != found[299]
    running = observer.start(y[0])
    for sample in zip(y[:200], u[:200], strict=True):
        running.step(*sample)
    running.reset(y[0])
    assert running.level_db == levels(observer, y[:1], u[:1])[0][0]
    assert drive().start(y[0]).level_db is None


def test_units_of_measure_and_files_change_nothing(tmp_path):
    observer, (y, u) = watched(drive()), samples(400)
    other = in_sizes(observer, {"position": 0.01, "velocity": 3.0, "target": 0.01})
    np.testing.assert_allclose(levels(other, y / 0.01, u / [0.01, 1])[0], levels(observer, y, u)[0], atol=1e-8)
    observer.save(tmp_path / "o.json")
    np.testing.assert_array_equal(levels(Observer.load(tmp_path / "o.json"), y, u)[0], levels(observer, y, u)[0])


def test_what_cannot_be_a_monitor_is_refused():
    filters = octaves(3)
    for wrong in (
        {"limits": np.ones((1, 2))},
        {"limits": np.zeros((1, 3))},
        {"size": np.full(1, np.nan)},
        {"forget": 0.0},
        {"filters": np.ones((3, 2))},
        {"weights": np.array([[8, 8, 1]])},
        {"weights": np.array([[8.5, 7.5, 0]])},
    ):
        with pytest.raises(DataError, match="Monitor of an observer"):
            Monitor(
                **(
                    {
                        "filters": filters,
                        "forget": 0.1,
                        "settle": 9,
                        "size": np.ones(1),
                        "limits": np.ones((1, 3)),
                        "weights": np.array([[8, 8, 0]]),
                    }
                    | wrong
                ),
                false_alarm_rate=0.1,
            )
    with pytest.raises(DimensionError, match=r"monitor should have shape \(1,\)"):
        replace(drive(), monitor=Monitor(filters, 0.1, 9, np.ones(2), np.ones((2, 3)), np.full((2, 3), [4, 4, 0]), 0.1))


def test_the_bound_is_that_of_one_more_unit():
    """Peaks of episodes one after the other, the bound by hand; a unit that shakes is outside."""
    simulated = HarmonicDrivePopulation(n_units=6, n_episodes=3, seconds=3.0, conditions=("noload",), seed=3).simulate()
    A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.zeros((2, 2))
    K = gain(np.array([[0.2], [10.0]]), DT)
    observer = Observer(
        "tracking",
        Lifting(("position", "velocity")),
        A,
        B,
        (0,),
        ("target_position", "target_velocity"),
        K,
        Injection.STATE,
        DT,
    )
    population = simulated.population
    training = TrainingSet(population, population.episodes, {u: {} for u in population.unit_ids})
    settings = MonitorSettings(false_alarm_rate=0.05)
    monitor = fit_monitor(observer, training, settings)
    own = replace(observer, monitor=monitor)
    records = {key: population.read(key) for key in population.episodes}
    found, watches = {}, {unit: Watch(monitor) for unit in population.unit_ids}
    for key, r in records.items():
        innovation, _ = run_innovations(observer, r[:, None, :1], r[:, None, 3:], settle=0)
        squares = watches[key.unit].mean_squares(innovation[:, 0], np.arange(len(r)) >= monitor.settle)
        found[key] = monitor.level(squares).max()
    peaks = np.array([[v for key, v in found.items() if key.unit == unit] for unit in population.unit_ids])
    of_motions, student = peaks.mean(axis=0), {5: 2.015048, 2: 2.919986}
    apart = [(of_motions[i] - of_motions[j]) ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
    highest, wider = peaks.max(axis=1), (student[2] ** 2 - student[5] ** 2) * np.mean(apart)
    over = prediction_bound(highest, 0.05) - highest.mean()
    assert abs(highest.mean() + np.sqrt(over**2 + wider)) < 1e-5  # levels are over the bound already
    assert monitor.units == 6
    forgets_nothing = replace(observer, controller=gain(np.zeros((2, 1)), DT))
    assert fit_monitor(forgets_nothing, training, settings).settle == len(r) // 4  # not whole short episodes
    loudest = records[max(found, key=found.get)]
    y, u = loudest[:, :1], loudest[:, 3:]
    shaken = y + 1e-2 * np.sin(100 * y)  # three short motions differ so much that the bound is wide
    status = [Course(own, watched=True).take(one[:, None], u[:, None]).status for one in (y, shaken)]
    assert [bool((one & SampleStatus.UNCERTIFIED).any()) for one in status] == [False, True]
    assert fit_monitor(observer, replace(training, keys=training.keys[:4]), settings) is None


@pytest.mark.parametrize(("units", "motions"), [(5, 3), (8, 4), (12, 3)])
def test_few_motions_widen_the_bound_until_its_rate_holds(units, motions):
    """Units and motions that are drawn, the motions for all units alike; a further unit has motions of its own."""
    rng, rate, draws = np.random.default_rng(7), 0.05, 2000
    own, shared = rng.normal(size=(draws, units + 1, 1)), 0.7 * rng.normal(size=(draws, 2, 1, motions))
    peaks = own[:, :units] + shared[:, 0]
    new = (own[:, units] + shared[:, 1, 0]).max(axis=1)
    bounds = np.array([bound_of_peaks(one.tolist(), MonitorSettings(rate)) for one in peaks])
    assert np.mean(new > bounds) < rate
    assert np.mean(new > prediction_bound(peaks.max(axis=2), rate)) > np.mean(new > bounds)
    many = peaks[0].repeat(3, axis=1)
    assert bound_of_peaks(many.tolist(), MonitorSettings(rate)) == prediction_bound(many.max(axis=1), rate)
