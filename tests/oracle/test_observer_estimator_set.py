"""What an estimator guarantees on every plant of an uncertain set, against interconnections, members and analytic values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from attained import attained
from recorded_plant import DT, FEW, LIFTING, plant
from scipy.special import hyp2f1

import kros
from kros.core import StateSpace, SynthesisError, gain, h2_norm, hinf_norm
from kros.design.certificates import certificate, error_maps
from kros.design.methods.estimator import Estimator
from kros.design.synthesize import tasks_of
from kros.lifting import Lifting
from kros.observer import Runtime, identify_estimator, run_observer
from kros.observer.estimator.bank import Bank
from kros.observer.estimator.certificate import linear_estimate
from kros.observer.estimator.channels import products, without_limits
from kros.observer.sensor import Sensor
from kros.synthesis import ObserverProblem
from kros.synthesis.worst_case.certificate import certify_errors, density
from kros.uncertainty import Form, rebuild

A, B = np.array([[1, 0.1, 0], [-0.1, 0.8, 0.2], [0, 0, 0.9]]), np.array([[0.0], [0.0], [0.1]])
NOMINAL = StateSpace(A, B, np.eye(3), np.zeros((3, 1)), DT)
SETTINGS = FEW.model_copy(update={"order": 6})


@pytest.fixture(scope="module")
def found():
    return identify_estimator("plant", LIFTING, (0,), ("u",), plant(spread=0.2)[0], DT, settings=SETTINGS)


def problem(form, size=0.3, seed=0, dynamic=False, **changes):
    """Return a problem around NOMINAL; weights are static or have a pole each."""
    rng, location = np.random.default_rng(seed), Form(form)
    rows, columns = location.sizes(3, 1)

    def weight(p, m):
        D = rng.standard_normal((p, m))
        if not dynamic:
            return gain(D / np.linalg.norm(D), DT)
        one = StateSpace([[0.7]], rng.standard_normal((1, m)), rng.standard_normal((p, 1)), D, DT)
        return replace(one, C=one.C / hinf_norm(one), D=one.D / hinf_norm(one))

    parts = {"W_L": weight(rows, rows), "W_R": weight(columns, columns), "noise": np.array([0.05])}
    parts |= {"input_scale": np.array([1.5]), "output_scale": np.array([0.8, 1.2, 0.5])}
    parts |= changes
    case = ObserverProblem(NOMINAL, np.eye(3)[:1], form=form, **parts)
    largest = hinf_norm(case.N) or 1.0
    W_L = case.W_L
    return replace(case, W_L=replace(W_L, C=W_L.C * size / largest, D=W_L.D * size / largest))


def maps_of(case, observer, lifting=LIFTING):
    estimate, mean = linear_estimate(observer, lifting)
    return estimate, case.estimate_error(estimate), np.diag(1 / case.output_scale)[: case.n_original] @ mean


def connected(case, estimate, true):
    """Return the error over its sizes from (scaled input, measurement noise) of a true plant, (3 states, 1 input)."""
    n, r = true.n_states, estimate.n_states
    F_y, F_u = estimate.B[:, :1], estimate.B[:, 4:]
    x, u = case.output_scale, case.input_scale
    A_all = np.block([[true.A, np.zeros((n, r))], [F_y @ true.C[:1], estimate.A]])
    B_all = np.block(
        [
            [true.B * u, np.zeros((n, 1))],
            [F_u * u + F_y @ true.D[:1] * u, F_y * case.noise],
        ]
    )
    C_all = np.hstack([true.C, -estimate.C]) / x[:, None]
    D_all = np.hstack([true.D * u, np.zeros((3, 1))]) / x[:, None]
    return StateSpace(A_all, B_all, C_all, D_all, DT)


def test_the_linear_estimate_is_the_observer_as_it_runs(found):
    observer = replace(found.observer, runtime=Runtime(0))
    estimate, mean = linear_estimate(observer, LIFTING)
    _, batches = plant(spread=0.2)
    batch = next(iter(batches.values()))
    x_hat = run_observer(observer, batch.states[..., :1], batch.inputs)[:, 0, :3]
    state, expected = np.zeros(estimate.n_states), []
    for x, u in zip(batch.states[:, 0], batch.inputs[:, 0], strict=True):
        expected.append(estimate.C @ state + mean)
        state = estimate.A @ state + estimate.B @ np.concatenate([x[:1], np.zeros(3), u])
    hidden = [1, 2]
    late, size = slice(300, 400), np.abs(x_hat[:, hidden]).max(axis=0)  # what the start left has decayed
    assert (np.abs(np.array(expected)[late, hidden] - x_hat[late, hidden]) < 1e-3 * size).all()


def test_without_uncertainty_it_is_the_norm_of_the_interconnection(found):
    for form in (Form.ADDITIVE, Form.INVERSE_INPUT_MULTIPLICATIVE):
        case = problem(form)
        case = replace(case, W_L=replace(case.W_L, D=0 * case.W_L.D))
        estimate, errors, mean = maps_of(case, found.observer)
        system = connected(case, estimate, NOMINAL)
        expected = np.hypot(h2_norm(system), np.linalg.norm(mean))
        assert certify_errors(case, errors, mean) == pytest.approx(expected, rel=2e-5)
        assert attained(case, errors, mean) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("form", Form)
def test_no_member_exceeds_the_density_with_dynamic_weights_and_a_remainder(form, found):
    rest = {"remainder_left": gain(0.1 * np.diag([1.0, 2.0, 0.5]), DT), "remainder_right": gain([[0.7]], DT)}
    W_u = StateSpace([[0.8]], [[0.3]], [[1.0]], [[0.1]], DT)
    case = problem(form, dynamic=True, W_u=W_u, **rest)
    estimate, errors, _ = maps_of(case, found.observer)
    freqs, rng = np.geomspace(1e-3, 49.9, 25), np.random.default_rng(2)
    limit = np.sqrt(density(case, errors, freqs))
    F, x, u = estimate.frequency_response(freqs), case.output_scale, case.input_scale
    G = NOMINAL.frequency_response(freqs) * u / x[:, None]
    W_L, W_R = case.W_L.frequency_response(freqs), case.W_R.frequency_response(freqs)
    largest = np.zeros(len(freqs))
    for _ in range(60):
        delta, rest_delta = (
            rng.standard_normal((len(freqs), *shape)) + 1j * rng.standard_normal((len(freqs), *shape))
            for shape in ((W_L.shape[2], W_R.shape[1]), (3, 1))
        )
        delta, rest_delta = (d / np.linalg.norm(d, 2, axis=(1, 2))[:, None, None] for d in (delta, rest_delta))
        true = [rebuild(case.form, g, e) for g, e in zip(G, W_L @ delta @ W_R, strict=True)]
        true = np.array(true) + case.remainder_left.D @ rest_delta * 0.7
        physical = true * x[:, None] / u
        error = (physical - F[..., :1] @ physical[:, :1] - F[..., 4:]) * u @ W_u.frequency_response(freqs)
        whole = np.concatenate([error, F[..., :1] * case.noise], axis=-1) / x[:, None]
        largest = np.maximum(largest, np.linalg.norm(whole, axis=(1, 2)))
    assert (largest <= limit * (1 + 1e-9)).all()
    assert (largest > 0.3 * limit).all()


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_scalar_plant(missing):
    a, b, w, noise = 0.6, 0.5, 0.3, 0.1
    lag = StateSpace([[a]], [[b]], [[1.0]], [[0.0]], DT)
    case = ObserverProblem(lag, [[1.0]], gain([[w]], DT), gain([[1.0]], DT), [1.0], [1.0], [noise], form="additive")
    estimate = StateSpace([[0.0]], [[a, 0.0, b - missing]], [[1.0]], [[0.0, 0.0, 0.0]], DT)  # a y + (b - missing) u
    errors, mean = case.estimate_error(estimate), 0.0
    straight = 2 * missing * w * hyp2f1(-0.5, -0.5, 1, a**2)  # mean of |1 - a exp(-i theta)|
    expected = np.sqrt(missing**2 + straight + w**2 * (1 + a**2) + (a * noise) ** 2)
    assert certify_errors(case, errors, mean) == pytest.approx(expected, rel=2e-5)
    assert attained(case, errors, mean) == pytest.approx(expected, rel=2e-3)


@pytest.fixture(scope="module")
def motors():
    population = kros.plants.DcMotorPopulation(n_units=4, n_episodes=3, seconds=1.5, seed=3).simulate().population
    return kros.quantify(kros.identify(population), n_freqs=80, max_order=1)


def test_every_unit_of_a_population_is_below_its_bound(motors):
    task = tasks_of(motors, "linear", [Estimator(SETTINGS)])[0]
    result = task.method.design(task)
    facts = certificate(task, result)
    errors, mean = error_maps(task, result, task.problem)
    bound = certify_errors(task.problem, errors, mean)
    assert attained(task.problem, errors, mean) <= bound
    assert facts["worst_case_h2"] == bound or "without an estimate" in facts["reason"]
    estimate, mean = linear_estimate(result.observer, task.models.lifting)
    for unit in task.covered:
        true = task.models.systems([unit])[0]
        own = connected(task.problem, estimate, StateSpace(true.A, true.B, np.eye(3), np.zeros((3, 1)), true.dt))
        assert np.hypot(h2_norm(own), np.linalg.norm(mean / task.problem.output_scale)) <= bound


def test_functions_of_the_model_count_and_others_are_refused():
    lifting = Lifting(("position", "velocity", "force"), functions=("sin(position)",))
    recordings = plant(spread=0.2)[0]
    found = identify_estimator("plant", lifting, (0,), ("u",), recordings, DT, settings=SETTINGS)
    estimate, _ = linear_estimate(found.observer, lifting)
    assert np.any(estimate.B[:, 4])  # the sine, the fourth lifted state, behind one measurement and three states
    with pytest.raises(SynthesisError, match=r"the models have no signal sin\(position\)\."):
        linear_estimate(found.observer, LIFTING)
    late = replace(found.observer, sensor={"position": Sensor(delay_samples=1)})
    with pytest.raises(SynthesisError, match="late"):
        linear_estimate(late, lifting)


def test_every_entry_of_a_bank_belongs_to_the_channel_that_moves_it():
    rng, bank = np.random.default_rng(0), Bank(4, 2, 1, 12, (5.0, 20.0), (2.0, 8.0))
    v = np.column_stack([rng.normal(size=(60, 3)), np.ones(60)])
    for channel in range(3):
        moved = v.copy()
        moved[:, channel] += rng.normal(size=60)
        changed = (bank.rows(moved, np.arange(60)) != bank.rows(v, np.arange(60))).any(axis=0)
        np.testing.assert_array_equal(changed, bank.channel == channel)


def test_messages_name_quantities_without_their_limits():
    texts = products(["angle"], ["drive"], {"angle": (-3.0, -1.0), "drive": (-6.5, 7.25)}, 0.25)
    assert [without_limits(text) for text in texts] == ["drive*abs(drive)", "drive**2", "drive*angle"]
