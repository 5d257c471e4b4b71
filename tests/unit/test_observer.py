"""The observer as it runs: batched, single, and on disk must be one and the same."""

import numpy as np
import pytest

from kros.core.errors import DataError, DimensionError
from kros.core.lti import StateSpace
from kros.data import EpisodeBatch
from kros.evaluate.errors import summarise
from kros.lifting import Lifting
from kros.observer import Observer, run_observer
from kros.observer.baselines.kalman import kalman_candidates
from kros.synthesis import Injection

LIFTING = Lifting(("position", "velocity", "current"), ("sin(10*position + phase)",), ("phase",))


def observer(injection=Injection.STATE, order=2, seed=0):
    rng = np.random.default_rng(seed)
    A, B = 0.3 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    width = 4 if injection is Injection.STATE else 2
    K = StateSpace(
        0.3 * rng.normal(size=(order, order)),
        rng.normal(size=(order, 1)),
        rng.normal(size=(width, order)),
        0.1 * rng.normal(size=(width, 1)),
        0.001,
    )
    return Observer("koopman/test", LIFTING, A, B, (0,), ("a", "b"), K, injection, 0.001, {"phase": 0.3})


def written_out(o, y, u, phase):
    """(18)-(21), line by line."""
    x, xc, found = np.array([y[0, 0], 0.0, 0.0]), np.zeros(o.controller.n_states), []
    for k in range(len(y)):
        found.append(x)
        nu = y[k] - x[:1]
        yc = o.controller.C @ xc + o.controller.D @ nu
        lifted = np.array([*x, np.sin(10 * x[0] + phase)])
        following = o.A @ lifted + (o.B @ (u[k] + yc) if o.injection is Injection.INPUT else o.B @ u[k] + yc)
        xc = o.controller.A @ xc + o.controller.B @ nu
        x = following[:3]
    return np.array(found)


@pytest.mark.parametrize("injection", [Injection.STATE, Injection.INPUT])
@pytest.mark.parametrize("order", [0, 3])
def test_batched_and_single_runs_equal_the_equations(injection, order):
    o = observer(injection, order)
    rng = np.random.default_rng(1)
    y, u, phases = rng.normal(size=(50, 3, 1)), rng.normal(size=(50, 3, 2)), np.array([0.0, 1.0, 2.0])
    batched = run_observer(o, y, u, {"phase": phases})
    for i, phase in enumerate(phases):
        expected = written_out(o, y[:, i], u[:, i], phase)
        np.testing.assert_allclose(batched[:, i], expected, rtol=1e-10, atol=1e-10)
        running = o.start(y[0, i], {"phase": phase})
        stepped = [running.estimate] + [running.step(y[k, i], u[k, i]) for k in range(49)]
        np.testing.assert_allclose(stepped, expected, rtol=1e-10, atol=1e-10)


def test_reset_starts_again():
    o = observer()
    running = o.start([0.5])
    first = running.step([0.4], [1.0, 2.0])
    running.step([0.1], [0.0, 0.0])
    running.reset([0.5])
    np.testing.assert_array_equal(running.step([0.4], [1.0, 2.0]), first)


def test_estimates_have_names_and_are_arrays():
    o = observer()
    running = o.start([0.5], phase=1.2)
    estimate = running.step([0.4], [1.0, 2.0])
    assert running.states == ("position", "velocity", "current") == tuple(estimate)
    assert [estimate[name] for name in running.states] == np.asarray(estimate).tolist() == list(estimate.values())
    assert np.asarray(estimate, dtype=np.float32).dtype == np.float32
    assert repr(estimate).startswith("Estimate(position=")
    assert repr(o).startswith("<Observer koopman/test: position, velocity, current")
    np.testing.assert_array_equal(estimate, o.start([0.5], {"phase": 1.2}).step([0.4], [1.0, 2.0]))
    np.asarray(estimate)[:] = 0.0  # what is done to it leaves the observer alone
    running.step([0.4], [1.0, 2.0])
    assert np.asarray(running.estimate).all()


@pytest.mark.parametrize("injection", [Injection.STATE, Injection.INPUT])
@pytest.mark.parametrize("order", [0, 2])
def test_the_file_holds_everything(tmp_path, injection, order):
    o = observer(injection, order)
    o.save(tmp_path / "o.json")
    again = Observer.load(tmp_path / "o.json")
    np.testing.assert_array_equal(again.one_step, o.one_step)
    assert (again.name, again.lifting, again.measured, again.inputs, again.parameters, again.injection) == (
        o.name,
        LIFTING,
        (0,),
        ("a", "b"),
        {"phase": 0.3},
        injection,
    )


def test_other_files_are_refused(tmp_path):
    (tmp_path / "x.json").write_text("[1, 2]")
    with pytest.raises(DataError, match="not an observer file"):
        Observer.load(tmp_path / "x.json")


def test_a_controller_of_the_wrong_size_is_refused():
    o = observer()
    with pytest.raises(DimensionError, match="1 innovations to 2 corrections"):
        Observer("x", LIFTING, o.A, o.B, (0,), ("a", "b"), o.controller, Injection.INPUT, 0.001)
    with pytest.raises(DimensionError, match="should agree"):
        run_observer(o, np.zeros((5, 2, 1)), np.zeros((4, 2, 2)))


def test_open_loop_equals_a_free_run_from_the_first_measurement():
    from kros.identify import free_run

    o = observer()
    silent = Observer.open_loop("open", LIFTING, o.A, o.B, (0,), ("a", "b"), 0.001)
    rng = np.random.default_rng(2)
    y, u = rng.normal(size=(30, 4, 1)), rng.normal(size=(30, 4, 2))
    x0 = np.concatenate([y[0], np.zeros((4, 2))], axis=1)
    free = free_run(o.A, o.B, LIFTING, {"phase": 0.7}, x0, np.swapaxes(u, 0, 1))
    np.testing.assert_allclose(np.swapaxes(run_observer(silent, y, u, {"phase": np.full(4, 0.7)}), 0, 1), free, rtol=1e-12, atol=1e-12)


def test_candidates_sweep_at_least_six_decades():
    A = np.array([[0.9, 0.1], [0.0, 0.8]])
    levels, gains = zip(*kalman_candidates(A, np.array([[1.0, 0.0]]), np.array([2.0, 5.0]), np.array([[1e-6]]), 0.01), strict=True)
    assert np.log10(levels[-1] / levels[0]) >= 6
    sizes = [abs(float(s.controller.D[0, 0])) for s in gains]
    assert sizes[0] < 1e-2
    assert sizes[-1] > 0.8
    assert all(np.diff(sizes) > -1e-9)


def test_summary_counts_only_real_samples_and_finds_power_in_a_band():
    t = np.arange(4000) * 1e-3
    truth = np.stack([np.sin(t), 2 * np.ones_like(t)], axis=1)[:, None, :].repeat(2, axis=1)
    estimate = truth.copy()
    estimate[:, 0, 0] += 0.1 * np.sin(2 * np.pi * 50 * t)
    estimate[3000:, 1] += 1e6
    summary = summarise(estimate, truth, np.array([4000, 3000]), 1e-3)
    assert summary.rms[0, 0] == pytest.approx(0.1 / np.sqrt(2), rel=1e-3)
    assert summary.percent[0, 0] == pytest.approx(100 * 0.1 / np.sqrt(2), rel=1e-2)
    assert np.all(summary.rms[1] == 0)
    assert summary.band_power((45, 55))[0, 0] == pytest.approx(0.1**2 / 2, rel=0.02)
    assert summary.band_power((100, 200))[0, 0] < 1e-6


def test_episodes_of_different_length_are_held_at_their_end():
    from kros.data import Channel, Role, from_arrays

    rng = np.random.default_rng(3)
    channels = [Channel("x", Role.STATE, "", True), Channel("u", Role.INPUT)]
    data = {"1": {"default": {"0": rng.normal(size=(30, 2)), "1": rng.normal(size=(20, 2))}}}
    population = from_arrays(data, channels, 0.1)
    batch = EpisodeBatch.read(population, population.episodes)
    assert batch.lengths.tolist() == [30, 20]
    np.testing.assert_array_equal(batch.states[20:, 1], np.broadcast_to(batch.states[19, 1], (10, 1)))


def test_spectra_of_short_and_long_episodes_share_their_frequencies() -> None:
    """Zero padding: a batch with an episode shorter than a Welch segment can be averaged with any other."""
    truth = np.ones((2000, 2, 1))
    estimate = truth + np.random.default_rng(0).normal(size=truth.shape)
    short = summarise(estimate, truth, np.array([2000, 300]), 1e-3)
    long = summarise(estimate, truth, np.array([2000, 2000]), 1e-3)
    np.testing.assert_array_equal(short.freqs_hz, long.freqs_hz)
    np.testing.assert_array_equal(short.spectra[0], long.spectra[0])
    power = short.spectra[1].sum() * short.freqs_hz[1]
    assert power == pytest.approx(1.0, abs=0.3)
