"""The loop of a controller over estimates: margins against python-control and formulas, bounds against members of the set."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import control
import numpy as np
import pytest

import kros
from kros.core import ConfigError, StateSpace, SynthesisError, block_diagonal, gain, hinf_norm
from kros.evaluate.closed_loop import Controller, close_loop
from kros.evaluate.closed_loop.linear_loop import LinearLoop, linear_estimator
from kros.evaluate.closed_loop.small_gain import Blocks, attained, least_level
from kros.observer import Observer, Runtime
from kros.synthesis import ObserverProblem
from kros.synthesis.generalized_plant import interconnect
from kros.uncertainty import Form, rebuild

DT = 0.1
LAG = StateSpace([[0.8]], [[0.5]], [[1.0]], [[0.0]], DT)
DELAY = StateSpace([[0.0]], [[1.0, 0.0, 0.0]], [[1.0]], np.zeros((1, 3)), DT)  # the last measurement is the estimate
TOLERANCE = 1e-4


def peak(blocks: Blocks, tolerance: float = TOLERANCE) -> tuple[float, float, float, np.ndarray]:
    """Bounds of the largest mu, its frequency, and a perturbation that attains the lower one."""
    upper, nu = least_level(blocks, blocks.places[1] >= 0, tolerance)
    lower, Delta = attained(blocks, nu)
    return upper, lower, float(np.arctan(nu) / (np.pi * DT)), Delta


def worst_gain(blocks: Blocks, tolerance: float = TOLERANCE) -> float:
    return least_level(blocks, blocks.places[1] == len(blocks.sizes) - 1, tolerance)[0]


def scalar_loop(form: str, weight: float, K: float) -> Blocks:
    problem = ObserverProblem(LAG, [[1.0]], gain([[weight]], DT), gain([[1.0]], DT), [1.0], [1.0], [1.0], form=form)
    return LinearLoop(problem, DELAY, gain([[K]], DT)).perturbed()


@pytest.mark.parametrize("K", [-0.2, -0.7, -1.1])
def test_margins_of_a_scalar_loop_are_those_of_python_control(K: float) -> None:
    """A perturbation of the input sees T, one of its inverse sees S: its margin is the least distance from -1."""
    L = -K * control.tf([0.5], [1, -0.8], DT) * control.tf([1], [1, 0], DT)
    distance = control.stability_margins(L)[2]
    omega = np.linspace(1e-4, np.pi / DT, 200_001)
    response = L(np.exp(1j * omega * DT))
    wanted = {"inverse_input_multiplicative": distance / 0.3}
    wanted["input_multiplicative"] = 1 / np.abs(0.3 * response / (1 + response)).max()
    for form, margin in wanted.items():
        upper, lower, *_ = peak(scalar_loop(form, 0.3, K).perturbation)
        assert 1 / lower == pytest.approx(margin, rel=1e-3)
        assert 1 / upper == pytest.approx(margin, rel=1e-3)
        assert lower <= upper


def test_the_worst_gain_is_that_of_all_perturbations_frequency_by_frequency() -> None:
    z = np.exp(1j * np.linspace(1e-3, np.pi, 1000))
    G, F, K = 0.5 / (z - 0.8), 1 / z, -0.6
    Delta = np.exp(1j * np.linspace(0, 2 * np.pi, 721))[:, None]  # the maximum is on the circle
    perturbed = G * (1 + 0.3 * Delta)
    wanted = np.abs((1 - F) * perturbed / (1 - K * F * perturbed)).max()
    assert worst_gain(scalar_loop("input_multiplicative", 0.3, K)) == pytest.approx(wanted, rel=1e-2)
    assert worst_gain(scalar_loop("input_multiplicative", 3.0, K)) == np.inf


def test_mu_of_known_matrices() -> None:
    def bounds(M, sizes):
        p, m = np.shape(M)
        static = StateSpace([[0.5]], np.zeros((1, m)), np.zeros((p, 1)), M, DT)
        upper, lower, *_ = peak(Blocks(static, sizes))
        assert lower <= upper
        return lower, upper

    two = [(1, 1), (1, 1)]
    assert bounds([[0, 8.0], [0.5, 0]], two) == pytest.approx([2.0, 2.0], rel=1e-3)  # sqrt(|m12 m21|)
    assert bounds([[3.0, 100.0], [0, 1.0]], two) == pytest.approx([3.0, 3.0], rel=1e-3)  # triangular
    assert bounds(np.outer([1.0, 2.0], [3.0, -1.0]), two) == pytest.approx([5.0, 5.0], rel=1e-3)  # rank one: sum |u v|
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(20):
        lower, upper = bounds(rng.standard_normal((5, 4)), [(2, 1), (1, 3), (1, 1)])
        ratios.append(upper / lower)
    assert np.median(ratios) < 1.05


A, B = np.array([[0.9, 0.1], [-0.1, 0.8]]), np.array([[0.0], [0.2]])
NOMINAL = StateSpace(A, B, np.eye(2), np.zeros((2, 1)), DT)


def stable(rng: np.random.Generator, p: int, m: int, size: float) -> StateSpace:
    one = StateSpace([[0.6]], rng.normal(size=(1, m)), rng.normal(size=(p, 1)), rng.normal(size=(p, m)), DT)
    return replace(one, C=one.C * size / hinf_norm(one), D=one.D * size / hinf_norm(one))


def matrix_loop(form: Form, remainder: bool) -> LinearLoop:
    """Two states, one input, an estimator that corrects, a controller with a state, dynamic weights."""
    rng, place = np.random.default_rng(3), Form(form)
    (rows, columns), scales = place.sizes(2, 1), ([1.0], [1.0, 1.0], [1.0])
    weights = stable(rng, rows, rows, 0.1), stable(rng, columns, columns, 1.0)
    more = {"remainder_left": stable(rng, 2, 2, 0.1), "remainder_right": stable(rng, 1, 1, 1.0)} if remainder else {}
    problem = ObserverProblem(NOMINAL, np.eye(2)[:1], *weights, *scales, form=form, **more)
    correction = np.array([[0.5], [0.2]])
    into = np.hstack([correction, np.zeros((2, 2)), B])
    F = StateSpace(A - correction @ np.eye(2)[:1], into, np.eye(2), np.zeros((2, 4)), DT)
    return LinearLoop(problem, F, StateSpace([[0.5]], [[0.1, 0.2]], [[-1.0]], [[-0.4, -0.6]], DT))


def member(blocks: Blocks, deltas: list[StateSpace]) -> StateSpace:
    """Close perturbations around a loop: the system from r to e."""
    w, z = np.sum(blocks.sizes[:-1], axis=0)
    r, e = blocks.sizes[-1]
    wires = {"Delta": {"M": np.eye(z, z + e)}, "M": {"Delta": np.eye(w + r, w), "r": np.eye(w + r, r, -w)}}
    systems = {"M": blocks.system, "Delta": block_diagonal(deltas)}
    return interconnect(systems, wires, {"r": r}, {"e": {"M": np.eye(e, z + e, z)}})


@pytest.mark.parametrize("remainder", [False, True])
@pytest.mark.parametrize("form", list(Form))
def test_a_member_of_the_set_is_the_plant_that_the_form_rebuilds(form: Form, remainder: bool) -> None:
    loop, rng, freqs_hz = matrix_loop(form, remainder), np.random.default_rng(4), np.array([0.03, 0.7, 4.0])
    blocks, problem = loop.perturbed(), loop.problem
    deltas = [stable(rng, w, z, 0.8) for w, z in blocks.sizes[:-1]]

    def product(*systems: StateSpace) -> np.ndarray:
        first, second, third = (system.frequency_response(freqs_hz) for system in systems)
        return first @ second @ third

    plant = problem.scaled_model.frequency_response(freqs_hz)
    plant = rebuild(form, plant, product(problem.W_L, deltas[0], problem.W_R))
    if remainder:
        plant = plant + product(problem.remainder_left, deltas[1], problem.remainder_right)
    F, K = loop.F.frequency_response(freqs_hz), loop.K.frequency_response(freqs_hz)
    estimate = F[..., :1] @ plant[:, :1] + F[..., 3:]
    wanted = (plant - estimate) @ np.linalg.inv(np.eye(1) - K @ estimate)
    np.testing.assert_allclose(member(blocks, deltas).frequency_response(freqs_hz), wanted, rtol=1e-9)


def all_pass(value: complex, z: complex) -> StateSpace:
    """Return a system with the same gain at all frequencies that has a value at z: ``g (1 - a z) / (z - a)``."""
    a = np.linspace(-0.99999, 0.99999, 200_001)
    phases = np.angle(np.multiply.outer([1, -1], (1 - a * z) / (z - a)) / value)
    side, place = np.unravel_index(np.abs(phases).argmin(), phases.shape)
    g, a = abs(value) * (1 - 2 * side), a[place]
    return StateSpace([[a]], [[1.0]], [[g * (1 - a * a)]], [[-g * a]], DT)


@pytest.mark.parametrize("remainder", [False, True])
@pytest.mark.parametrize("form", [Form.INVERSE_ADDITIVE, Form.INVERSE_INPUT_MULTIPLICATIVE, Form.OUTPUT_MULTIPLICATIVE])
def test_the_perturbation_that_is_found_destabilises_and_none_within_the_margin_does(form, remainder) -> None:
    blocks, rng = matrix_loop(form, remainder).perturbed(), np.random.default_rng(5)
    sizes = blocks.sizes[:-1]
    upper, lower, at_hz, Delta = peak(blocks.perturbation, 0.01)
    z, ends = np.exp(2j * np.pi * at_hz * DT), np.cumsum([(0, 0), *sizes], axis=0)

    def is_stable(size: float) -> bool:
        deltas = []
        for (w0, z0), (w1, z1) in pairwise(ends):
            left, _, right = np.linalg.svd(Delta[w0:w1, z0:z1])
            column, row = ([all_pass(v, z) for v in vector] for vector in (size * left[:, 0], right[0]))
            column, row = block_diagonal(column) @ gain(np.ones((len(column), 1)), DT), block_diagonal(row)
            deltas.append(column @ gain(np.ones((1, row.n_outputs)), DT) @ row)
        return bool(member(blocks, deltas).is_stable())

    assert not is_stable(1.01 / lower)
    assert is_stable(0.99 / upper)
    assert 1 <= upper / lower < 1.1
    bound = worst_gain(replace(blocks, system=scaled(blocks, 0.9 / upper)), 0.01)
    gains = []
    for _ in range(8):
        deltas = [stable(rng, *size, 0.9 / upper) for size in sizes]
        gains.append(hinf_norm(member(blocks, deltas)))
    assert hinf_norm(member(blocks, [gain(np.zeros(size), DT) for size in sizes])) <= bound
    assert max(gains) <= bound


def scaled(blocks: Blocks, size: float) -> StateSpace:
    """Return the loop of a set of another size."""
    by = np.where(blocks.places[1] < len(blocks.sizes) - 1, size, 1.0)[:, None]
    return replace(blocks.system, C=blocks.system.C * by, D=blocks.system.D * by)


@pytest.fixture(scope="module")
def motors():
    settings = {"n_units": 5, "n_episodes": 3, "seconds": 1.0, "seed": 3}
    population = kros.plants.DcMotorPopulation(**settings).simulate().population
    return kros.quantify(kros.identify(population, refine=False), n_freqs=50, max_order=1)


def observer_of(found, name="linear_edmd/simple") -> Observer:
    """A model with every estimate corrected by a tenth of its own innovation, of current and velocity."""
    models = found.models.models()
    row, n = models.index(found.nominal), models.lifting.n_lifted
    parts = models.lifting, models.A[row], models.B[row], models.measured, models.recorded_inputs
    K = gain(0.3 * np.eye(n)[:, list(models.measured)], models.sample_period_s)
    return Observer(name, *parts, K, "state", models.sample_period_s)


def controller(found, value: float, **more) -> Controller:
    period = found.models.models().sample_period_s
    return Controller(D=[[value]], sample_period_s=period, inputs=["velocity"], outputs=["voltage"], **more)


def radii(found, value: float) -> dict[str, float]:
    """Spectral radii of the loop of every unit, written out."""
    models, observer = found.models.models(), observer_of(found)
    n, x = models.lifting.n_lifted, models.lifting.states.index("velocity")
    C, L, K = np.eye(n)[list(models.measured)], observer.controller.D, value * np.eye(n)[x : x + 1]
    loops = {}
    for unit in found.sets["linear_edmd"].unit_ids:
        own, B = (m[models.index(unit)] for m in (models.A, models.B))
        loop = np.block([[own, B @ K], [L @ C, observer.A - L @ C + observer.B @ K]])
        loops[unit] = float(np.abs(np.linalg.eigvals(loop)).max())
    return loops


def test_a_controller_that_destabilises_one_unit_is_found(motors) -> None:
    low, high = 0.0, 100.0
    assert sum(radius >= 1 for radius in radii(motors, high).values()) == 5
    while sum(radius >= 1 for radius in radii(motors, high).values()) != 1:
        middle = (low + high) / 2
        low, high = (middle, high) if max(radii(motors, middle).values()) < 1 else (low, middle)
    result = close_loop(observer_of(motors), motors, controller(motors, high))
    assert result.status == "NOT SAFE"
    assert result.spectral_radius == pytest.approx(radii(motors, high), abs=1e-9)
    (bad,) = [unit for unit, radius in result.spectral_radius.items() if radius >= 1]
    assert f"it is unstable with {bad}" in result.reasons
    assert (
        close_loop(observer_of(motors), motors, controller(motors, 100.0)).diverged
        == motors.sets["linear_edmd"].unit_ids
    )


def test_a_controller_of_python_control_is_taken_and_a_safe_loop_is_proven(motors) -> None:
    system = control.ss([], [], [], [[-0.01]], motors.models.models().sample_period_s,
                        inputs=["velocity"], outputs=["voltage"])  # fmt: skip
    result = close_loop(observer_of(motors), motors, system)
    assert result.status == "SAFE"
    assert 1 < result.margin <= result.destabilising
    assert result.nominal_gain <= result.error_gain
    assert result.lines()[0].startswith("SAFE: stability is proven for")


def test_what_cannot_be_judged_is_said(motors) -> None:
    late = replace(observer_of(motors), runtime=Runtime(delay=2))
    result = close_loop(late, motors, controller(motors, -0.01))
    assert (result.status, result.margin) == ("UNDECIDED", None)
    assert "late" in result.lines()[0]
    with pytest.raises(SynthesisError, match="not stable by itself"):
        linear_estimator(replace(observer_of(motors), A=2 * np.eye(3)), motors.models.models().lifting)
    with pytest.raises(ConfigError, match="signal 'speed' is unknown; there are"):
        close_loop(observer_of(motors), motors, controller(motors, 0.0).model_copy(update={"inputs": ("speed",)}))
    with pytest.raises(ConfigError, match="sampled at"):
        close_loop(observer_of(motors), motors, controller(motors, 0.0).model_copy(update={"sample_period_s": 1.0}))
    with pytest.raises(ConfigError, match="0 inputs and 0 outputs named"):
        close_loop(observer_of(motors), motors, gain([[1.0]], motors.models.models().sample_period_s))
    for name, matrix in (("D", ((1.0, 2.0),)), ("B", ((1.0,),))):
        wrong = controller(motors, 0.0).model_copy(update={name: matrix})
        with pytest.raises(ConfigError, match=f"{name} should have the shape"):
            close_loop(observer_of(motors), motors, wrong)


def test_a_limit_of_the_actuator_keeps_an_unstable_loop_bounded(motors) -> None:
    limited = close_loop(observer_of(motors), motors, controller(motors, 100.0, limits={"voltage": (-6.0, 6.0)}))
    assert (limited.status, limited.diverged) == ("NOT SAFE", ())


def test_limits_are_in_the_units_of_the_recordings(motors) -> None:
    observer = replace(observer_of(motors), about={"columns": {"voltage": {"factor": -0.001}}})
    ends = controller(motors, 0.0, limits={"voltage": (-6.0, 12.0)}).ends(observer, ("voltage", "torque"))
    np.testing.assert_allclose(ends, [[-0.012, -np.inf], [0.006, np.inf]])
    assert np.all(np.isinf(controller(motors, 0.0).ends(observer, ("voltage",))))
    for name in ("volts", "velocity"):
        with pytest.raises(ConfigError, match=f"signal '{name}' is unknown"):
            close_loop(observer_of(motors), motors, controller(motors, 0.0, limits={name: (-6.0, 6.0)}))
