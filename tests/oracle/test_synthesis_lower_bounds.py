"""Lower bounds of worst-case designs against observers that are there: none may lie above what somebody attains."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from kros.core import StateSpace, SynthesisError, block_diagonal, gain
from kros.synthesis import Injection, ObserverProblem, Status, Synthesis, worst_case_h2
from kros.synthesis.result import enclosed
from kros.synthesis.riccati.kalman import predictor_bound
from kros.synthesis.worst_case.arcs import Enclosure, least_ratio
from kros.synthesis.worst_case.ball import Ball
from kros.synthesis.worst_case.certificate import certify
from kros.synthesis.worst_case.disturbance import Channels, Shaping, design_grid
from kros.synthesis.worst_case.everywhere import Everywhere

DT = 1.0
FULL = StateSpace([[0.6]], [[1.0, 0.3]], [[0.1], [0.05]], [[0.2, 0.1], [0.0, 0.2]], DT)


def stored(name):
    """A problem from its matrices."""
    parts = json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text())
    for key, value in parts.items():
        if isinstance(value, dict):
            parts[key] = StateSpace(*(value[k] for k in "ABCD"), value["dt"])
    return ObserverProblem(**{**parts, "injection": Injection(parts["injection"])})


def resonance(radius, angle, size=1.0, feed=0.0):
    """One lightly damped mode with a peak of about `size` above `feed`."""
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return StateSpace(A, [[1.0], [0.0]], [[0.0, 2 * size * (1 - radius)]], [[feed]], DT)


def small_problem(**changes):
    parts = {
        "nominal": StateSpace([[0.9, 0.1], [0.0, 0.7]], [[0.0], [0.5]], np.eye(2), np.zeros((2, 1)), DT),
        "C": [[1.0, 0.0]],
        "W_L": gain([[0.3]], DT),
        "W_R": gain([[1.0]], DT),
        "input_scale": [1.0],
        "output_scale": [1.0, 1.0],
        "noise": [0.1],
    }
    return ObserverProblem(**{**parts, **changes})


def others(problem, found, rng, count=6):
    """Observers that are not the one found: perturbed, and none."""
    K = found.controller
    yield gain(np.zeros_like(K.D), K.dt)
    for size in np.geomspace(0.01, 0.5, count):
        other = StateSpace(
            K.A,
            K.B * (1 + size * rng.standard_normal(K.B.shape)),
            K.C,
            K.D + size * np.abs(K.D).max() * rng.standard_normal(K.D.shape),
            K.dt,
        )
        if problem.error_system(other).is_stable():
            yield other


# --- the population whose bound was above what is attained


def test_a_lightly_damped_population():
    """An open-loop observer guarantees 24.81, whatever the order of the shaping filters; the bound lies below, and is
    worth something."""
    case = stored("lightly_damped_population")
    nothing = certify(case, gain(np.zeros((4, 1)), case.nominal.dt))[0]
    assert nothing == pytest.approx(24.81, abs=0.005)
    found = worst_case_h2(case)
    assert found.worst_case_h2 <= nothing
    assert 0.7 * nothing < found.lower_bound < found.worst_case_h2
    assert found.gap_percent == pytest.approx(100 * (found.worst_case_h2 / found.lower_bound - 1))


# --- filters below a spectrum between the points of any grid


@pytest.mark.parametrize("angle", [0.4, 1.9, 3.0])
def test_a_peak_between_the_points_of_the_grid_lowers_the_filter(angle):
    """The filter exceeds the spectrum (a constant) at its resonance alone, which is a hundredth of the grid's step
    wide."""
    case = small_problem()
    channels = Channels(case, design_grid(case), apart=True)
    peak = resonance(1 - 1e-5, angle, size=5.0, feed=0.5)
    grid = np.abs(peak.frequency_response(channels.freqs_hz)).max()
    fine = np.abs(peak.frequency_response((angle + np.linspace(-3e-5, 3e-5, 2001)) / (2 * np.pi))).max()
    assert fine > 3 * grid
    spectrum = channels.average()
    lowered = Everywhere(channels).lowered(Shaping(peak, None, None), spectrum).filters
    scale = lowered.D[0, 0] / 0.5
    assert scale == pytest.approx(min(1.0, np.sqrt(spectrum.phi[0, 0]) / fine), rel=5e-3)
    assert scale * fine <= np.sqrt(spectrum.phi[0, 0])


def test_a_response_stays_within_its_enclosure():
    rng = np.random.default_rng(0)
    for _ in range(10):
        A = rng.standard_normal((5, 5))
        A *= rng.uniform(0.5, 0.999) / np.abs(np.linalg.eigvals(A)).max()
        T = np.diag(10.0 ** rng.uniform(-4, 4, 5))
        B, C, D = (rng.standard_normal(shape) for shape in ((5, 2), (3, 5), (3, 2)))
        system = StateSpace(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), D, DT)
        theta = rng.uniform(0, np.pi, 40)
        half = 10.0 ** rng.uniform(-4, -1, 40)
        middle, distance = Enclosure(system)(theta, half)
        assert np.isfinite(distance).sum() >= 10
        for share in np.linspace(-1, 1, 9):
            there = system.frequency_response((theta + share * half) / (2 * np.pi))
            assert np.all(np.linalg.norm(there - middle, axis=-1) <= distance)
        small = Enclosure(system)(theta, half * 1e-3)[1]
        moved = system.frequency_response((theta + half * 1e-3) / (2 * np.pi)) - middle
        assert np.median(small / np.linalg.norm(moved, axis=-1)) < 1.5, "tight on short arcs"


def test_the_least_ratio_is_found_and_proven():
    """``2 + cos(k theta)`` with its Lipschitz constant k: the least value is one."""
    k = np.array([3.0, 40.0])

    def ratio(theta, half):
        seen = 2 + np.cos(theta[:, None] * k)
        return np.maximum(seen - k * half[:, None], 0.0), seen

    found = least_ratio(ratio, np.linspace(0, np.pi, 5), rtol=1e-3)
    assert np.all(found <= 1)
    assert np.all(found >= 1 - 1e-3)
    assert np.all(least_ratio(ratio, np.linspace(0, np.pi, 5), rtol=1e-3, max_arcs=1) == 0), (
        "nothing is proven without work"
    )


# --- the error of the optimal filter


def random_model(rng, n=5, k=4, q=2, spread=0.0):
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.3, 0.99) / np.abs(np.linalg.eigvals(A)).max()
    T = np.diag(10.0 ** rng.uniform(-spread, spread, n))
    B, C = rng.standard_normal((n, k)), rng.standard_normal((q, n))
    D = np.hstack([rng.standard_normal((q, k - q)) * 0.3, np.eye(q)])
    Z = rng.standard_normal((3, n))
    return T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), D, Z @ np.linalg.inv(T)


@pytest.mark.parametrize("spread", [0.0, 5.0])
def test_the_least_error_is_the_optimum_in_all_units(spread):
    rng = np.random.default_rng(1)
    for _ in range(10):
        plain = random_model(rng)
        A, B, C, D, Z = plain
        P = solve_discrete_are(A.T, C.T, B @ B.T, D @ D.T, s=B @ D.T)
        optimum = np.trace(Z @ P @ Z.T)
        T = np.diag(10.0 ** rng.uniform(-spread, spread, len(A)))
        proven = predictor_bound(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), D, Z @ np.linalg.inv(T))
        assert proven == pytest.approx(optimum, rel=1e-9)


TWO = block_diagonal([resonance(0.99, 1.0, 0.3, 0.1), gain([[0.2]], DT)])
REST = gain([[0.1, 0.05], [0.0, 0.1]], DT)


# --- whole designs


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"injection": Injection.INPUT},
        {"W_L": resonance(0.999, 1.3, 0.4, 0.1)},
        {"form": "input_multiplicative", "W_R": resonance(0.995, 0.7, 2.0, 0.2)},
        {"form": "additive", "W_L": TWO, "W_R": gain([[1.0], [0.5]], DT)},
        {"form": "inverse_output_multiplicative", "W_L": FULL, "W_R": gain(np.eye(2), DT)},
        {"remainder_left": REST, "remainder_right": gain([[1.0]], DT), "W_L": gain([[0.01]], DT)},
    ],
    ids=["plain", "input", "resonant", "resonant chain", "additive", "full weight", "correlated remainder"],
)  # fmt: skip
def test_no_observer_is_below_the_bound(changes):
    case = small_problem(**changes)
    found = worst_case_h2(case, max_order=1)
    assert 0.4 * found.worst_case_h2 < found.lower_bound <= found.worst_case_h2
    rng = np.random.default_rng(0)
    for injection in (Injection.STATE, Injection.INPUT):
        same = small_problem(**{**changes, "injection": injection})
        mine = worst_case_h2(same, max_order=1)
        assert mine.lower_bound <= found.worst_case_h2
        for K in others(same, mine, rng):
            assert certify(same, K)[0] >= max(found.lower_bound, mine.lower_bound)


def test_bound_of_a_white_set_is_the_kalman_optimum():
    """Scalar constants: the worst spectrum is white of size ``(w / (1 - w))^2``, nothing is lost anywhere."""
    case = small_problem()
    A, B, C, W_p = case.scaled
    P = solve_discrete_are(A.T, C.T, (0.3 / 0.7) ** 2 * B @ B.T, np.eye(1))
    found = worst_case_h2(case)
    assert found.lower_bound == pytest.approx(np.sqrt(np.trace(W_p @ P @ W_p.T)), rel=1e-2)
    assert found.lower_bound <= np.sqrt(np.trace(W_p @ P @ W_p.T)) <= found.worst_case_h2


# --- what is handed on


def test_a_bound_above_what_is_attained_is_never_a_result():
    lower, gap, notes = enclosed(2.0, 2.1)
    assert lower is None
    assert gap is None
    assert "2.1 above the attained 2" in notes[0]
    assert enclosed(2.0, None)[:2] == (None, None)
    assert enclosed(2.0, 1.0) == (1.0, 100.0, ())
    assert enclosed(0.0, None) == (0.0, None, ())
    assert enclosed(1.0, 1.0 + 1e-9) == (1.0, 0.0, ())
    with pytest.raises(SynthesisError, match="lies above what is attained"):
        Synthesis("any", gain([[0.0]], DT), Status.CERTIFIED, lower_bound=2.0, gap_percent=-1.0)


# --- what is proven on an arc, against the definition


def looped(**changes):
    """A set whose loop and chain are resonant; inverse additive: the perturbation sees the state that it drives."""
    parts = {"form": "inverse_additive", "W_L": resonance(0.98, 1.1, 0.2, 0.1), "W_R": gain([[0.3, 0.1]], DT)}
    return small_problem(**{**parts, **changes})


@pytest.mark.parametrize("form", ["inverse_additive", "additive"])
def test_a_perturbation_that_is_held_keeps_what_is_proven(form):
    """The element of a contraction in the middle of an arc, the same perturbation at other frequencies of the arc."""
    changes = (
        {}
        if form == "inverse_additive"
        else {"W_L": gain(np.eye(2), DT), "W_R": resonance(0.97, 0.8, 1.0, 0.3), "form": form}
    )
    case = looped(**changes)
    channels = Channels(case, design_grid(case), apart=True)
    proofs, rng = Everywhere(channels), np.random.default_rng(0)
    theta, half = rng.uniform(0.05, 3.0, 60), 10.0 ** rng.uniform(-4, -2, 60)
    b, a = case.W_L.n_inputs, case.W_R.n_outputs
    contractions = rng.standard_normal((len(channels.freqs_hz), b, a)) + 1j * rng.standard_normal(
        (len(channels.freqs_hz), b, a)
    )
    contractions /= np.linalg.norm(contractions, 2, axis=(-2, -1))[:, None, None]
    spectrum = replace(channels.average(), theta=contractions)
    proven, seen = proofs.disturbance(spectrum, theta, half)
    theta_hz = theta / (2 * np.pi)
    if case.N is None:
        delta = contractions[channels.nearest(theta)]
    else:
        N = case.N.frequency_response(theta_hz)
        X = Ball.of(N, np.broadcast_to(np.eye(a, dtype=complex), (60, a, a)), b)
        X = X.center + X.left @ contractions[channels.nearest(theta)] @ X.right
        delta = np.linalg.solve(np.eye(b) + X @ N, X)
    assert np.linalg.norm(delta, 2, axis=(-2, -1)).max() <= 1 + 1e-9

    def size(there):
        M = case.M.frequency_response(there / (2 * np.pi))
        N = np.zeros((60, a, b)) if case.N is None else case.N.frequency_response(there / (2 * np.pi))
        return np.linalg.norm(delta @ np.linalg.solve(np.eye(a) - N @ delta, M), axis=-1)

    assert seen == pytest.approx(size(theta), rel=1e-9)
    for share in np.linspace(-1, 1, 7):
        assert np.all(proven <= size(theta + share * half))
    finer = proofs.disturbance(spectrum, theta, half * 1e-4)[0]
    assert finer == pytest.approx(seen, rel=2e-3)


@pytest.mark.parametrize("size", [1e-4, 0.01, 0.3])
def test_correlated_channels_stay_above_what_is_proven_as_matrices(size):
    """The average of a set whose channels are correlated, at any place of an arc, minus the diagonal that is proven
    there: no negative eigenvalue."""
    case = small_problem(form="inverse_output_multiplicative", W_L=FULL, W_R=gain(np.eye(2), DT))
    channels = Channels(case, design_grid(case), apart=True)
    rng = np.random.default_rng(2)
    theta, half = rng.uniform(0.35, 2.8, 80), size * rng.uniform(0.3, 1.0, 80)
    proven, seen = Everywhere(channels).disturbance(channels.average(correlated=True), theta, half)
    diagonal = proven[:, :, None] ** 2 * np.eye(2)
    for share in np.linspace(-1, 1, 21):
        f = (theta + share * half) / (2 * np.pi)
        average = Ball.of(case.N.frequency_response(f), case.M.frequency_response(f), case.W_L.n_inputs).average()
        assert np.linalg.eigvalsh(average - diagonal)[:, 0].min() >= -1e-12
    if size < 1e-3:
        assert np.all(proven >= 0.98 * seen)


def least_on_a_fine_grid(filters, power_of):
    theta = np.unique(np.concatenate([np.geomspace(1e-5, np.pi, 20000), np.linspace(1e-3, np.pi, 20000)]))
    magnitude = np.linalg.norm(filters.frequency_response(theta / (2 * np.pi)), axis=-1)
    return np.min(np.sqrt(power_of(theta / (2 * np.pi))) / magnitude, axis=0)


def test_filters_are_lowered_by_the_least_ratio_and_no_further():
    """Averages, what the ball holds around its centre, and the remainder, on a grid a hundred times finer."""
    left = StateSpace(np.diag([0.9, 0.5]), np.eye(2), [[0.1, 0.0], [0.0, 0.2]], np.diag([0.02, 0.05]), DT)
    case = looped(remainder_left=left, remainder_right=resonance(0.9, 2.0, 0.5, 0.5))
    channels = Channels(case, design_grid(case), apart=True)
    proofs, high = Everywhere(channels), StateSpace([[0.8]], [[1.0]], [[1.0]], [[50.0]], DT)
    two = block_diagonal([high, high])
    shaping = Shaping(high, None, two)

    def ball(f):
        return Ball.of(case.N.frequency_response(f), case.M.frequency_response(f), case.W_L.n_inputs)

    def remainder(f):
        L, Q = left.frequency_response(f), case.remainder_right.frequency_response(f)
        return np.sum(np.abs(L) ** 2, axis=-1) * np.sum(np.abs(Q) ** 2, axis=(-2, -1))[:, None] / 2

    found = proofs.lowered(shaping, channels.average())
    expected = least_on_a_fine_grid(high, lambda f: np.real(np.einsum("fii->fi", ball(f).average())))
    assert found.filters.D.ravel() / 50 == pytest.approx(expected, rel=5e-3)
    assert np.all(found.filters.D.ravel() / 50 <= expected)
    expected = least_on_a_fine_grid(two, remainder)
    assert np.diag(found.remainder.D) / 50 == pytest.approx(expected, rel=5e-3)
    assert np.all(np.diag(found.remainder.D) / 50 <= expected)


@pytest.mark.parametrize("pole", [1.0, 1.02, 3.0])
def test_a_state_that_grows_but_is_seen_has_a_bound(pole):
    """One unstable state, measured with noise: the scalar Riccati equation has a closed form, whatever drives the
    machine."""
    q, r = 0.3, 0.7  # variances of what drives the state and of the measurement
    b = r * (1 - pole**2) - q
    error = (-b + np.sqrt(b**2 + 4 * q * r)) / 2  # p = pole^2 p r / (p + r) + q
    found = predictor_bound(
        np.array([[pole]]),
        np.array([[np.sqrt(q), 0.0]]),
        np.ones((1, 1)),
        np.array([[0.0, np.sqrt(r)]]),
        np.array([[1.0]]),
    )
    assert found == pytest.approx(error, rel=1e-9)
