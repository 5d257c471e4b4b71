"""The filter-bank estimator against what is known otherwise: its system, least squares, exact plants, and conditional means over losses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from batches import batch_of, run_with_status
from machines import filters
from recorded_plant import DT, FEW, LIFTING, estimator, plant, recorded_motors
from scipy.signal import lfilter

import kros
from kros.core.errors import ConfigError
from kros.data import EpisodeBatch
from kros.data.population import EpisodeKey
from kros.evaluate.sensor import as_shown
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Observer, Recordings, SampleStatus, Sensor, identify_estimator
from kros.observer.estimator.bank import Bank
from kros.observer.estimator.certificate import noise_response
from kros.observer.estimator.channels import FAMILIES, channels_of
from kros.observer.estimator.reduction import Filters, reduced
from kros.observer.estimator.regression import Moments, Readout, Whitening, condition_weights
from kros.observer.estimator.rows import Design
from kros.observer.simulate import Course, run_observer


def design(recordings, family="linear", settings=FEW, largest_input=3.0):
    ranges = {"position": (-3.0, 3.0), "u": (-largest_input, largest_input)}
    channels = channels_of(LIFTING, (0,), ("u",), family, ranges, settings)
    return Design.of(channels, recordings, settings)


@pytest.fixture(scope="module")
def exact():
    recordings, batches = plant()
    return identify_estimator("plant", LIFTING, (0,), ("u",), recordings, DT, settings=FEW), batches


@pytest.fixture(scope="module")
def motors() -> tuple[Observer, EpisodeBatch]:
    population, recordings = recorded_motors()
    observer = estimator(recordings, Lifting(population.states), inputs=population.inputs, dt=1e-3)
    return observer, EpisodeBatch.read(population, list(population.keys()))


def test_a_bank_is_its_system():
    rng = np.random.default_rng(0)
    bank = Bank(4, 3, 1, 12, (5.0, 20.0), (2.0, 8.0), (8 + 3j, 20 - 4j))
    v = np.column_stack([rng.normal(size=(60, 3)), np.ones(60)])
    rows = bank.rows(v, np.arange(60))
    A, B, S = bank.system()
    state = S @ v[0]
    for k in range(60):
        state = A @ state + B @ v[k]
        np.testing.assert_allclose(state, rows[k], atol=1e-12)
    assert len(bank) == rows.shape[1]
    begin, first = np.repeat([7, 20], 30), rng.normal(size=(60, 4))
    first[:30], first[30:], first[:, 3] = first[0], first[30], 1.0
    at = begin + np.tile(np.arange(30), 2)
    for k, one in ((7, first[0]), (20, first[30])):
        some = begin == k
        alone = bank.rows(np.vstack([one, v[k + 1 :]]), at[some] - k) - rows[at[some]]
        np.testing.assert_allclose(bank.restarted(v, first, begin, at)[some], alone, atol=1e-12)


def test_a_fit_is_the_same_in_any_units_of_measure():
    """Squares of an input in millionths are larger by a factor of 1e12, positions are not."""
    recordings, _ = plant(units=2, spread=0.1)

    def in_millionths(key):
        batch = recordings.read(key)
        return replace(batch, inputs=1e6 * batch.inputs)

    same = design(replace(recordings, read=in_millionths), "products", largest_input=3e6)
    (one,), (other,) = Readout.of([design(recordings, "products")]), Readout.of([same])
    np.testing.assert_allclose(other.left_out, one.left_out, rtol=1e-6)


def test_banks_of_families_are_parts_of_the_richer_one():
    recordings, _ = plant(units=2, spread=0.1)
    *parts, whole = (design(recordings, family) for family in FAMILIES[:3])
    (_, rows, *_), *_ = whole.rows(recordings, FEW.rows)
    for part in parts:
        (_, wanted, *_), *_ = part.rows(recordings, FEW.rows)
        places = whole.bank.places(part.bank)
        np.testing.assert_allclose(rows[:, places], wanted, atol=1e-12)
        one, other = whole.sample().of(places), part.sample()
        for name in ("rows", "restarts", "elsewhere", "errors"):
            a, b = getattr(one, name), getattr(other, name)
            np.testing.assert_allclose(a.T @ a, b.T @ b, atol=1e-12 * np.abs(b).max(initial=0.0) ** 2, err_msg=name)


def test_a_lifting_that_makes_models_affine_has_the_same_channels():
    ranges = {"position": (-3.0, 3.0), "u": (-3.0, 3.0)}
    affine = replace(LIFTING, inputs=("u",), input_functions=("1",))
    for family in FAMILIES:
        one, other = (channels_of(lifting, (0,), ("u",), family, ranges, FEW) for lifting in (affine, LIFTING))
        assert [f.text for f in one.lifting.input_formulas] == [f.text for f in other.lifting.input_formulas]


def test_coefficients_are_those_of_least_squares_with_the_penalty_as_rows():
    recordings, _ = plant(units=3, spread=0.1)
    made = design(recordings)
    whitening = Whitening.of(made, made.sample())
    (moments,) = Moments.of([made], [whitening])
    penalty, start, share = 1e-6, 0.2, 0.1
    (found,) = moments.solved(np.ones(len(moments.groups)), [(penalty, start, share)])
    parts: dict = {}
    for key, rows, targets, weights in made.rows(recordings, FEW.rows):
        parts.setdefault(made.groups[key], []).append((rows @ whitening.directions, targets, weights))
    X, T = [], []
    for own in parts.values():
        size = np.sqrt(sum(w.sum() for *_, w in own) * len(parts))
        X += [F * np.sqrt(w)[:, None] / size for F, _, w in own]
        T += [t * np.sqrt(w)[:, None] / size for _, t, w in own]
    errors = whitening.trust + start * whitening.elsewhere + share * whitening.disturbed
    prior = errors + penalty * np.diag(whitening.penalty)
    root = np.linalg.cholesky(prior).T
    stacked = np.vstack([*X, root]), np.vstack([*T, np.zeros((len(root), 3))])
    np.testing.assert_allclose(found, np.linalg.lstsq(*stacked, rcond=None)[0], atol=1e-6 * np.abs(found).max())


def test_an_exact_plant_is_estimated_exactly(exact):
    found, batches = exact
    batch = next(iter(batches.values()))
    estimate = run_observer(found.observer, batch.states[..., :1], batch.inputs)
    late = FEW.delays + 1  # what was before the first sample is unknown until delays have passed it
    error = np.sqrt(np.mean((estimate[late:, 0, :3] - batch.states[late:, 0]) ** 2, axis=0))
    assert (error[1:] < 1e-3 * np.abs(batch.states).max(axis=(0, 1))[1:]).all()


def test_reduced_filters_are_stable_at_every_order_and_tend_to_the_bank():
    recordings, batches = plant(units=3, spread=0.2)
    (readout,) = Readout.of([design(recordings)])
    batch = next(iter(batches.values()))
    v = readout.design.channels.signals(batch.states[:, 0, :1], batch.inputs[:, 0], {})
    wanted = readout.design.bank.rows(v, np.arange(len(v))) @ readout.coefficients[:, :3]
    apart = []
    for order in (1, 3, 6, 12):
        filters = reduced(readout, order)
        assert np.abs(np.linalg.eigvals(filters.A)).max() < 1
        z, estimates = filters.S @ v[0], []
        for row in v:
            estimates.append((filters.C @ z + filters.D @ row)[:3])
            z = filters.A @ z + filters.B @ row
        apart.append(np.sqrt(np.mean((np.array(estimates) - wanted)[:, 1:] ** 2)))
    assert apart[-1] < 0.02 * apart[0]


def test_modes_give_the_same_estimates_with_two_multiplications_a_state_unless_they_are_alike():
    rng = np.random.default_rng(2)
    modes, lag = rng.normal(size=(5, 5)), np.diag([0.99, 0.9, 0.9, 0.5, -0.3])
    lag[1, 2], lag[2, 1] = 0.3, -0.3
    rest = rng.normal(size=(5, 2)), rng.normal(size=(3, 5)), rng.normal(size=(3, 2)), rng.normal(size=(5, 2))
    filters = Filters(modes @ lag @ np.linalg.inv(modes), *rest)
    turned, v = filters.modal(), rng.normal(size=(300, 2, 2))
    assert np.count_nonzero(turned.A) == 7
    np.testing.assert_allclose(turned.along(v), filters.along(v), rtol=0, atol=1e-9)  # rounding times the condition
    alike = replace(filters, A=np.array([[0.7, 0.2], [0.0, 0.7]]))
    assert alike.modal() is alike


def test_a_reduction_keeps_its_digits_where_coefficients_cancel():
    """A channel and its double, with coefficients that leave the sum of both: the filters estimate as without them, however large they are."""
    recordings, batches = plant(units=3, spread=0.2)
    lifting = replace(LIFTING, functions=("2*position",))
    channels = channels_of(lifting, (0,), ("u",), "linear", {"position": (-3.0, 3.0), "u": (-3.0, 3.0)}, FEW)
    (readout,) = Readout.of([Design.of(channels, recordings, FEW)])
    bank, errors = readout.design.bank, readout.typical * recordings.size
    batch = next(iter(batches.values()))
    v = channels.signals(batch.states[:, 0, :1], batch.inputs[:, 0], {})
    readout = replace(readout, coefficients=readout.coefficients[:, :3])
    wanted = bank.rows(v, np.arange(len(v))) @ readout.coefficients
    lag = len(channels) - 1 + bank.delayed * (bank.delays - 1)
    large = readout.coefficients.copy()
    large[lag : lag + 2] += 1e10 * np.outer([2.0, -1.0], errors)
    filters = reduced(replace(readout, coefficients=large))
    z, estimates = filters.S @ v[0], []
    for row in v:
        estimates.append(filters.C @ z + filters.D @ row)
        z = filters.A @ z + filters.B @ row
    assert (np.sqrt(np.mean((np.array(estimates) - wanted) ** 2, axis=0)) < errors)[1:].all()


def test_errors_are_those_of_units_and_episodes_that_coefficients_do_not_know():
    recordings, _ = plant(units=3, episodes=2, spread=0.3)
    settings = FEW.model_copy(update={"parts": 2, "rows": 100_000, "penalties": (1e-8,)})
    (readout,) = Readout.of([design(recordings, settings=settings)])
    key = recordings.keys[0]
    others = [k for k in recordings.keys if k.unit != key.unit and k.episode != key.episode]
    alone = replace(recordings, keys=tuple(others), lengths=recordings.lengths[: len(others)])
    made = design(alone, settings=settings)
    whitening = Whitening.of(readout.design, readout.design.sample())
    (moments,) = Moments.of([made], [whitening])
    weights = 1e-8, 0.0, settings.settled_share
    (coefficients,) = moments.solved(np.ones(len(moments.groups)), [weights])
    group = readout.design.groups[key]
    np.testing.assert_allclose(
        readout.others[group][:, 1],
        whitening.directions @ coefficients[:, 1],
        rtol=1e-4,
        atol=1e-6 * np.abs(coefficients).max(),
    )


def test_left_out_errors_are_those_of_penalties_that_other_units_chose():
    recordings, _ = plant(units=4, episodes=2, spread=0.6)
    made = design(recordings, settings=FEW.model_copy(update={"parts": 1, "rows": 1000, "sample": 1000}))
    (readout,), (moments,) = Readout.of([made]), Moments.of([made], [Whitening.of(made, made.sample())])
    settings, weights = made.settings, condition_weights(moments, made.settings.restart_share)
    candidates = [(penalty, 0.0, settings.settled_share) for penalty in settings.penalties]
    others, folds = moments.without(weights, candidates), moments.of_groups("fold")
    errors = np.array([moments.errors(others[g])[i] for i, g in enumerate(moments.groups)])
    differing = 0
    for i, fold in enumerate(folds):
        choice = np.log(errors[folds != fold]).mean(axis=0).argmin(axis=0)
        np.testing.assert_allclose(readout.left_out[i], errors[i, choice, range(3)], rtol=1e-6)
        differing += (choice != np.log(errors).mean(axis=0).argmin(axis=0)).any()
    assert differing


def test_a_start_without_time_constants_of_its_own_is_that_of_the_lags(exact):
    recordings, _ = plant(units=3, spread=0.1)
    bank = design(recordings, settings=FEW.model_copy(update={"start": ()})).bank
    assert bank.starts == bank.lags
    assert np.isfinite(Readout.of([design(recordings, settings=FEW.model_copy(update={"start": ()}))])[0].typical).all()


def test_few_episodes_of_the_regression_leave_no_group_without_moments():
    recordings, _ = plant(units=5, episodes=7, spread=0.1)
    settings = FEW.model_copy(update={"episodes": 4})
    (readout,) = Readout.of([design(recordings, settings=settings)])
    assert set(readout.others) == set(readout.design.groups.values())
    assert readout.episode_errors().shape == (35, 3)


def test_a_declared_bias_is_an_error_of_the_regression_and_hardly_felt_then():
    recordings, batches = plant(units=3, spread=0.1)
    biased = replace(recordings, bias=np.array([0.5]))
    made = design(biased)
    bank = made.bank
    of_y = np.flatnonzero(bank.channel == 0)
    delays = bank.channels - 1 + np.arange(bank.delayed * (bank.delays - 1))
    moved = np.isin(np.arange(len(bank)), np.setdiff1d(of_y[: -len(bank.starts)], delays))  # and not the first sample
    errors = design(biased).sample().errors
    np.testing.assert_allclose((errors.T @ errors)[moved][:, moved], 0.25, atol=1e-12)
    batch, errors = next(iter(batches.values())), []
    for one in (recordings, biased):
        observer = estimator(one)
        runs = (run_observer(observer, batch.states[..., :1] + b, batch.inputs)[..., 1:3] for b in (0.5, 0.0))
        errors.append(np.sqrt(np.mean(np.subtract(*runs) ** 2, axis=(0, 1))))
    assert (errors[1] < 0.5 * errors[0]).all()


@pytest.mark.parametrize("size", [0.02, 0.1, 1.0])
def test_wrong_samples_are_taken_as_missing(motors, size):
    observer, batch = motors
    rng = np.random.default_rng(0)
    wrong = rng.random((*batch.states.shape[:2], 1)) < 0.02
    wrong[:20] = False
    shift = size * np.abs(batch.states[..., :1]).max()
    spikes = batch.states[..., :1] + np.where(wrong, shift, 0.0)
    missing = np.where(wrong, np.nan, batch.states[..., :1])
    found, status = run_with_status(observer, spikes, batch.inputs)
    np.testing.assert_array_equal(found[..., :3], run_observer(observer, missing, batch.inputs))
    assert (status[wrong[..., 0]] & SampleStatus.LIMIT).all()


def test_a_wrong_first_sample_is_outvoted(motors):
    observer, batch = motors
    y = batch.states[..., :1].copy()
    y[0] += 0.3 * np.abs(y).max()
    found, wanted = (Course(observer, y.shape[1]).take(y[k:], batch.inputs[k:]).estimates for k in (0, 2))
    filters = slice(3, 3 + observer.bank.filters)
    np.testing.assert_allclose(found[3:, :, filters], wanted[1:, :, filters], atol=1e-8 * np.abs(wanted).max())


def test_a_wrong_sample_right_after_a_gap_is_missing_too_and_noise_widens_gates(motors):
    observer, batch = motors
    y, size = batch.states[..., :1].copy(), np.abs(batch.states[..., 0]).max()
    y[200:230] = np.nan
    wrong, missing, noise = y.copy(), y.copy(), 0.5 * observer.bank.gate * np.random.default_rng(1).normal(size=y.shape)
    wrong[230], missing[230] = y[230] + 0.3 * size, np.nan
    np.testing.assert_array_equal(*(run_observer(observer, each, batch.inputs) for each in (wrong, missing)))
    status = run_with_status(observer, y + noise, batch.inputs)[1]
    assert np.mean(status[300:] & SampleStatus.LIMIT > 0) < 0.5  # without, most are refused


@pytest.mark.parametrize("fault", ["stuck", "shifted for good"])
def test_a_sensor_that_is_wrong_for_long_is_believed_again_and_its_fault_forgotten(motors, fault):
    observer, batch = motors
    assert observer.bank is not None
    y = np.concatenate([batch.states[..., :1]] * 6)  # jumps where a recording ends
    u, begin = np.concatenate([batch.inputs] * 6), 300
    if fault == "stuck":
        y[begin : begin + 200] = y[begin]
    else:
        y[begin:] += 0.3 * np.abs(y).max()
    found, wanted = run_observer(observer, y, u), run_observer(observer, y[-500:], u[-500:])
    last = slice(-200, None)
    size = np.abs(batch.states).max(axis=(0, 1))
    assert (np.sqrt(np.mean((found[last] - wanted[last]) ** 2, axis=(0, 1))) < 0.05 * size).all()
    assert observer.bank.patience < 500


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 0.9, 0.95])
def test_any_pattern_of_losses_leaves_the_estimate_bounded_and_is_forgotten(motors, share):
    observer, batch = motors
    rng = np.random.default_rng(int(100 * share))
    y, size = batch.states[..., :1], np.abs(batch.states).max(axis=(0, 1))
    lost = rng.random(y.shape) < share
    lost[0], lost[300:] = False, False
    estimate, status = run_with_status(observer, np.where(lost, np.nan, y), batch.inputs)
    assert (np.abs(estimate[..., :3]) < 3 * size).all()
    assert set(np.unique(status)) <= {0, 1, 4, 5}
    undisturbed = run_observer(observer, y, batch.inputs)
    apart = np.abs(estimate[..., :3] - undisturbed).max(axis=1) / size
    assert (apart[-1] < 0.05).all()
    assert (apart[-1] <= apart[300:].max(axis=0) + 1e-12).all()


@pytest.mark.parametrize("persistence", [0.0, 0.8])
def test_an_input_that_is_lost_goes_on_with_its_change_and_starts_nothing_anew(motors, persistence):
    observer, batch = motors
    observer = replace(observer, bank=replace(observer.bank, persistence=np.array([persistence])))
    y, u = batch.measurements((0,)), batch.inputs
    lost, held, going_on = u.copy(), u.copy(), np.cumsum(persistence ** np.arange(1, 51))[:, None, None]
    lost[100:150], held[100:150] = np.nan, u[99] + going_on * (u[99] - u[98])
    wanted = run_observer(observer, y, held)
    np.testing.assert_allclose(run_observer(observer, y, lost), wanted, atol=1e-9 * np.abs(wanted).max())
    moved = y + np.where(np.arange(len(y)) == 100, 2 * observer.bank.gate, 0.0)[:, None, None]
    refused = [run_with_status(observer, moved, each)[1][100] & SampleStatus.LIMIT > 0 for each in (lost, u)]
    assert not refused[0].any()  # the input may be wrong
    assert refused[1].all()
    running = observer.start(y[0, 0])
    unknown = np.isnan(lost[:, 0]).all(axis=-1)
    rows = [np.asarray(running.step(y[k, 0], None if unknown[k] else lost[k, 0])) for k in range(499)]
    np.testing.assert_allclose(rows, wanted[1:, 0], atol=1e-8 * np.abs(wanted).max())
    assert running.states == tuple(running.estimate) == observer.recorded  # no internal states
    assert wanted.shape[-1] == len(observer.recorded) < observer.lifting.n_states


def test_measurements_are_believed_however_far_the_estimate_from_inputs_is(motors):
    observer, batch = motors
    narrow = replace(observer, bank=replace(observer.bank, reach=0.3 * observer.bank.reach))
    runs = (run_observer(one, batch.measurements((0,)), batch.inputs) for one in (observer, narrow))
    np.testing.assert_array_equal(*runs)


def test_how_changes_of_inputs_last_is_estimated():
    changes = lfilter([1], [1, -0.9], np.random.default_rng(0).normal(size=(4, 5000)))
    inputs = {"a": [np.stack([c, np.cumsum(c), np.arange(5000.0)], axis=1) for c in changes]}
    inputs = kros.from_arrays(inputs, states=["x"], measured=["x"], inputs=["u", "r"], sample_period_s=1.0)
    found = Recordings.of(list(inputs.keys()), lambda key: EpisodeBatch.read(inputs, [key])).persistence
    np.testing.assert_allclose(found, [0.9, np.exp(-1 / 5000)], rtol=0.01)


@pytest.mark.parametrize("reference", [False, True])
def test_a_position_that_goes_on_for_ever_changes_nothing(reference):
    """The same motion a thousand turns on gives the same estimates, with and without losses, and no gain at rest."""
    population, _ = recorded_motors()
    names, inputs = population.states, (*population.inputs, "reference")[: 1 + reference]

    def read(key: EpisodeKey) -> EpisodeBatch:
        batch = EpisodeBatch.read(population, [key])
        rng = np.random.default_rng(int(key.episode))
        along = batch.states[:, :, :1] + rng.normal(size=batch.inputs.shape)
        return replace(batch, inputs=np.concatenate([batch.inputs, along], axis=-1)[..., : len(inputs)])

    recordings = Recordings.of(list(population.keys()), read)
    free = FEW.model_copy(update={"unbounded": {names[0]: inputs[1:]}})
    observer = estimator(recordings, Lifting(names), inputs=inputs, dt=1e-3, settings=free)
    batch, turns = read(recordings.keys[0]), 2 * np.pi * 1000
    y, moved = batch.measurements([0]), batch.inputs + np.array([0.0, turns])[: len(inputs)]
    lost = np.where(np.random.default_rng(0).random(y.shape) < 0.5, np.nan, y)
    for shown in (y, lost):
        here = run_observer(observer, shown, batch.inputs)[..., :3]
        there = run_observer(observer, shown + turns, moved)[..., :3] - [turns, 0, 0]
        np.testing.assert_allclose(there, here, atol=1e-6 * np.abs(batch.states).max())
    response = noise_response(observer)
    if not reference:
        still = response.C @ np.linalg.solve(np.eye(len(response.A)) - response.A, response.B) + response.D
        np.testing.assert_allclose(still[1:], 0.0, atol=1e-9)
    wrong = FEW.model_copy(update={"unbounded": {names[1]: ()}})
    with pytest.raises(ConfigError, match="unbounded should map measured states"):
        estimator(recordings, Lifting(names), inputs=inputs, dt=1e-3, settings=wrong)


def test_estimates_stay_inside_declared_limits():
    population, recordings = recorded_motors()
    parts = recordings, Lifting(population.states, sizes=(("current", 2.0),)), (0,), population.inputs, 1e-3
    batch = recordings.read(recordings.keys[0])
    top = 0.5 * float(np.abs(batch.states[..., 2]).max())
    declared = FEW.model_copy(update={"limits": {"current": (-2 * top, 2 * top)}})  # in the recordings' unit
    free, limited = (
        run_observer(estimator(*parts, settings=one), batch.measurements([0]), batch.inputs) for one in (FEW, declared)
    )
    np.testing.assert_array_equal(limited[2:, :, 2], np.clip(free[2:, :, 2], -top, top))  # a start has a fallback
    np.testing.assert_array_equal(limited[..., :2], free[..., :2])
    for limits in ({"torque": (0.0, 1.0)}, {"current": (1.0, 0.0)}):
        wrong = FEW.model_copy(update={"limits": limits})
        with pytest.raises(ConfigError, match="should be the least and the largest value of one of position, velocity"):
            estimator(*parts, settings=wrong)


def test_declared_losses_do_not_change_what_is_learned():
    population, recordings = recorded_motors(2, 2)
    sensor, parts = {population.measured[0]: Sensor(dropout=0.3)}, (Lifting(population.states), (0,), population.inputs)
    shown = replace(recordings, read=lambda key: as_shown(recordings.read(key), sensor, population.states))
    one, other = (estimator(each, *parts, dt=1e-3) for each in (recordings, shown))
    np.testing.assert_array_equal(one.A, other.A)


def from_rest(places: list[float], seed: int) -> tuple[Recordings, dict]:
    """A decaying oscillator that starts at rest at given places, where its measurement alone says what follows."""
    A = np.array([[1.0, 0.01], [-0.04, 0.996]])
    rng, batches = np.random.default_rng(seed), {}
    for episode, place in enumerate(places):
        for unit in ("a", "b", "c", "d"):
            x, u = np.zeros((400, 2)), 0.3 * rng.standard_normal((400, 1))
            x[0] = place, 0.0
            for k in range(399):
                x[k + 1] = A @ x[k] + [0.0, 0.05 * u[k, 0]]
            measured = x + 1e-3 * rng.standard_normal(x.shape)
            key = EpisodeKey(unit, "default", str(episode))
            batches[key] = batch_of(measured[:, None], u[:, None], 0.01)
    return Recordings.of(list(batches), batches.__getitem__), batches


def test_machines_recorded_from_rest_are_estimated_where_they_start_in_motion_too():
    lifting = Lifting(("position", "velocity"))
    rng, settings = np.random.default_rng(3), {"delays": 16, "rows": 6000, "start_share": 1e-12, "gap_samples": 1200}
    recordings, _ = from_rest(list(rng.uniform(-2, 2, 6)), 1)
    unseen = from_rest(list(rng.uniform(-2, 2, 4)), 2)[1]
    errors = []
    for share in (1e-12, 0.1):
        chosen = EstimatorSettings(**settings, restart_share=share, settled_share=1e-4 * share)
        observer = estimator(recordings, lifting, settings=chosen)
        off = []
        for begin in (0, 150):
            runs = [run_observer(observer, b.states[begin:, :, :1], b.inputs[begin:])[:, 0, 1] for b in unseen.values()]
            off.append([x - b.states[begin:, 0, 1] for x, b in zip(runs, unseen.values(), strict=True)])
        errors.append([np.sqrt(np.mean(np.square(one))) for one in off])
    speed = np.sqrt(np.mean([b.states[..., 1] ** 2 for b in unseen.values()]))
    assert errors[1][1] < 0.5 * errors[0][1]
    assert errors[1][0] < 0.05 * speed


def test_a_machine_without_inputs_has_an_estimator():
    batches = {k: replace(b, inputs=b.inputs[..., :0]) for k, b in from_rest([-2.0, -1.0, 0.5, 1.5], 1)[1].items()}
    recordings = Recordings.of(list(batches), batches.__getitem__)
    observer = estimator(recordings, Lifting(("position", "velocity")), inputs=())
    batch = next(iter(batches.values()))
    speed = run_observer(observer, batch.states[..., :1], batch.inputs)[:, 0, 1]
    assert np.std(speed - batch.states[:, 0, 1]) < 0.1 * np.std(batch.states[:, 0, 1])


def test_a_machine_that_follows_its_reference_starts_at_rest_elsewhere_as_well():
    rng, batches = np.random.default_rng(0), {}
    for episode, place in enumerate([1.0, 1.1, 1.25, 1.4, 1.5, -2.0]):
        for unit in ("a", "b", "c", "d"):
            x, u = np.zeros((400, 2)), np.full((400, 1), place)
            u[20:] += 3.0 * np.cumsum(rng.standard_normal((380, 1)), axis=0) / 20
            x[0] = place, 0.0
            for k in range(399):
                x[k + 1] = [[1.0, 0.01], [-0.5, 0.9]] @ x[k] + [0.0, 0.5 * u[k, 0] - 0.2 * np.sin(5 * x[k, 0])]
            key = EpisodeKey(unit, "default", str(episode))
            batches[key] = batch_of(x[:, None] + 1e-5 * rng.standard_normal((400, 1, 2)), u[:, None], 0.01)
    recordings = Recordings.of([key for key in batches if key.episode != "5"], batches.__getitem__)
    errors = []
    for shares in ({"start_share": 1e-12, "restart_share": 1e-12}, {}):
        chosen = EstimatorSettings(delays=16, rows=6000, gap_samples=1200, **shares)
        observer = estimator(recordings, Lifting(("position", "velocity")), settings=chosen)
        observer = replace(observer, bank=replace(observer.bank, doubt=0 * observer.bank.doubt))  # it is known to rest
        unseen = [b for key, b in batches.items() if key.episode == "5"]
        off = [run_observer(observer, b.states[..., :1], b.inputs)[:50, 0, 1] - b.states[:50, 0, 1] for b in unseen]
        errors.append(np.sqrt(np.mean(np.square(off))))
    assert errors[1] < 0.4 * errors[0]


def conditioned(observer, y, lost):
    """The filters' states before every sample as means of all errors of one step, given what has arrived: with no recursion over gaps."""
    bank, n, r = observer.bank, 3, observer.bank.filters
    at, rows = list(observer.measured), [*range(n), *range(n, n + r)]
    A, B = observer.A[rows], observer.B[rows, -1]
    count, q = y.shape
    first = Course(observer).take(y[:1, None], np.zeros((1, 1, 2))).estimates[0, 0]
    z, known = first[n : n + r].copy(), y[0].copy()  # means without errors, and how they follow from errors
    by_z, by_y = np.zeros((r, count * q)), np.zeros((q, count * q))
    seen, wanted, found, variance = [], [], [], np.tile(bank.noise**2, count)
    for k in range(count):
        if k:
            arrived = ~lost[k]
            seen += list(by_y[arrived])
            wanted += list(y[k, arrived] - known[arrived])
        H = np.array(seen).reshape(-1, count * q)
        error = (
            variance * (H.T @ np.linalg.lstsq(H * variance @ H.T, np.array(wanted), rcond=None)[0])
            if seen
            else np.zeros(count * q)
        )
        found.append((z + by_z @ error, known + by_y @ error))
        x = A[:, n : n + r] @ z + A[:, at] @ known + B
        by_x = A[:, n : n + r] @ by_z + A[:, at] @ by_y
        z, known, by_z, by_y = x[n:], x[at], by_x[n:], by_x[at].copy()
        if k + 1 < count:
            by_y[:, (k + 1) * q : (k + 2) * q] += np.eye(q)
    return found


@pytest.mark.parametrize("measured", [(0,), (0, 2)])
def test_filters_after_losses_are_what_all_that_has_arrived_says(measured):
    """Without functions and inputs, the recursion gives the conditional means of a Gaussian vector."""
    observer = filters(functions=(), measured=measured)
    bank = observer.bank
    closed = dict.fromkeys(("reach", "rest", "gate"), np.full(len(measured), 1e6))
    A, B = observer.A.copy(), observer.B.copy()
    A[6:9], B[6:9] = A[:3], B[:3]  # one readout for all time
    observer = replace(observer, A=A, B=B, bank=replace(bank, doubt=np.zeros((2, 2)), **closed))
    rng, count = np.random.default_rng(5), 40
    y, lost = rng.normal(size=(count, len(measured))), rng.random((count, len(measured))) < 0.6
    lost[:2], lost[15:25] = False, True
    course, shown, u = Course(observer), np.where(lost, np.nan, y)[:, None], np.zeros((count, 1, 2))
    first = course.take(shown[:1], u[:1]).estimates
    course.steps.gaps.believed[...] = 1e4  # long after a start
    found = np.concatenate([first, course.take(shown[1:], u[1:]).estimates])[:, 0]
    for k, (z, known) in list(enumerate(conditioned(observer, y, lost)))[2:]:
        # what arrived at k itself enters at the next sample
        if not lost[k].all():
            continue
        np.testing.assert_allclose(found[k, 3:5], z, atol=1e-8)
        np.testing.assert_allclose(found[k, list(measured)], known, atol=1e-8)


def test_a_start_in_motion_is_known_after_few_samples():
    """An oscillator by its position: innovations correct filters that are doubted, where the first step is beyond `rest`."""
    lifting, rng = Lifting(("position", "velocity")), np.random.default_rng(3)
    recordings, _ = from_rest(list(rng.uniform(-2, 2, 6)), 1)
    unseen = from_rest(list(rng.uniform(-2, 2, 4)), 2)[1]
    observer = estimator(recordings, lifting, settings=EstimatorSettings(delays=16, rows=6000, gap_samples=1200))
    errors = []
    for doubt in (0.0, 1.0):
        one = replace(
            observer, bank=replace(observer.bank, doubt=doubt * observer.bank.doubt, rest=observer.bank.rest / 5)
        )
        runs = [
            (run_observer(one, b.states[150:, :, :1], b.inputs[150:])[:, 0, 1], b.states[150:, 0, 1])
            for b in unseen.values()
        ]
        errors.append(np.sqrt(np.mean([(x - v)[5:50] ** 2 for x, v in runs])))
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("pattern", [(10, 1), (10, 10), (20, 2), (20, 5), (100, 5)])
def test_regular_losses_cost_no_more_than_the_loss_of_everything(motors, pattern):
    observer, batch = motors
    y, (gone, there) = batch.states[..., :1].copy(), pattern
    lost, size = np.arange(len(y)) % (gone + there) < gone, np.abs(batch.states).max(axis=(0, 1))
    lost[:100] = False
    errors = []
    for some in (lost, np.arange(len(y)) >= 100):
        shown = np.where(some[:, None, None], np.nan, y)
        apart = run_observer(observer, shown, batch.inputs)[100:, :, 1:3] - batch.states[100:, :, 1:3]
        errors.append(np.sqrt(np.mean(apart**2, axis=(0, 1))) / size[1:3])
    assert (errors[0] < 1.2 * errors[1]).all()


def test_candidates_are_compared_without_groups_in_which_a_state_rests():
    recordings, _ = plant(units=3, episodes=3, spread=0.1)
    made = design(recordings, settings=FEW.model_copy(update={"parts": 3}))
    (moments,) = Moments.of([made], [Whitening.of(made, made.sample())])
    parts = moments.of_groups("part")
    errors = np.zeros((len(parts), 4, 3))
    errors[:, 2:] = 0.1  # the other penalty is no better
    errors[parts < 2, 2:, 0] = -60.0  # but where the first state is zero
    resting = replace(moments, power=np.where((parts < 2)[:, None] & (np.arange(3) == 0), 0.0, 1.0))
    np.testing.assert_array_equal(resting.best(np.exp(errors)), np.repeat([0, 1], 3))
    errors[:, 2:] = -0.3
    np.testing.assert_array_equal(resting.best(np.exp(errors)), np.repeat([2, 3], 3))


def test_gaps_of_pendulums_are_no_worse_than_the_model_alone():
    pendulums = kros.plants.PendulumPopulation(n_units=5, n_episodes=4, seconds=10.0, seed=3).simulate().population
    uncertain = kros.quantify(
        kros.identify(pendulums, lifting=["sin(position)"], refine=False), n_freqs=50, max_order=1
    )
    designs = [
        kros.synthesize(
            uncertain, f"koopman_edmd/{method}", methods=(), estimator={"folds": 2, "parts": 2, "gap_samples": 1200}
        )
        for method in ("estimator", "open_loop")
    ]
    keys = uncertain.models.facts.test
    batch = EpisodeBatch.read(pendulums, keys, 1000, uncertain.models.parameters)
    y = batch.states[..., :1].copy()
    y[300:700] = np.nan
    estimate = run_observer(designs[0].observer, y, batch.inputs)
    first = estimate[300, :, :2]
    model, x = designs[1].observer, first
    errors = []
    for k in range(300, 700):
        errors.append([estimate[k, :, :2] - batch.states[k], x - batch.states[k]])
        lifted = model.lifting.lift(x, {}), model.lifting.lift_inputs(batch.inputs[k], x, {})
        x = (lifted[0] @ model.A.T + lifted[1] @ model.B.T)[:, :2]
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert (rms[0] <= 1.2 * rms[1]).all()


@pytest.fixture(scope="module")
def two_sensors():
    """A motor of which position and current are measured."""
    population, recordings = recorded_motors(4, 4)
    observer = estimator(recordings, Lifting(population.states), (0, 2), population.inputs, population.sample_period_s)
    return observer, EpisodeBatch.read(population, list(population.keys()))


@pytest.mark.parametrize("lost", [0, 1])
def test_one_of_two_sensors_that_is_lost_for_ever_leaves_the_estimate_bounded(two_sensors, lost):
    observer, batch = two_sensors
    again = 40
    y, u = (np.tile(part, (again, 1, 1)) for part in (batch.states[..., [0, 2]], batch.inputs))
    size = np.abs(batch.states).max(axis=(0, 1))
    y[200:-200, :, lost] = np.nan
    estimate = run_observer(observer, y, u)[..., :3]
    assert (np.abs(estimate) < 4 * size).all()  # a range from what inputs say


@pytest.mark.parametrize("late", [[0], [1], [0, 1]])
def test_filters_start_at_the_first_sample_with_all_measurements_and_those_of_inputs_go_on(two_sensors, late):
    observer, batch = two_sensors
    y, u, n = batch.states[..., [0, 2]].copy(), batch.inputs, len(observer.recorded)
    wanted, whole = (Course(observer, y.shape[1]).take(y[k:], u[k:]).estimates for k in (30, 0))
    y[:30, :, late] = np.nan
    found = Course(observer, y.shape[1]).take(y, u).estimates
    filters, inputs = slice(n, n + observer.bank.filters), slice(n + observer.bank.filters, -2 * n)
    for part, other in ((filters, wanted[1:]), (inputs, whole[31:])):
        scale = np.abs(other[..., part]).max()
        np.testing.assert_allclose(found[31:, :, part], other[..., part], atol=1e-8 * scale)
    velocity, from_inputs = (found[1:31, :, k] for k in (1, 1 - n))
    np.testing.assert_allclose(velocity, from_inputs, atol=1e-9 * np.abs(velocity).max())
