"""The certificate of the observer as it runs, against truths it does not know."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import isqrt

import numpy as np
import pytest
from adversary import attack, attack_running
from contracting import contracting
from scipy.optimize import minimize

from kros.core.lti import StateSpace, gain
from kros.core.norms import hinf_norm
from kros.lifting import Lifting
from kros.observer import Observer
from kros.observer.certificate.certificate import ReliftCertificate, ReliftStatus, relift_certificate
from kros.observer.certificate.error import ErrorSystem, ReliftScales, error_system
from kros.observer.certificate.proof import best_multipliers, positive, proposals, proven, proven_gain
from kros.synthesis import Injection


def scalar(a: float, b: float, correction: float = 0.0) -> Observer:
    """x+ = a x + b sin(x) + u, corrected by a constant gain."""
    model = np.array([[a, b], [0.0, 0.0]])
    lifting, B, K = Lifting(("x",), ("sin(x)",)), np.array([[1.0], [0.0]]), gain([[correction], [0.0]], 1.0)
    return Observer("scalar", lifting, model, B, (0,), ("u",), K, Injection.STATE, 1.0)


def random_observer(rng, functions, order=3, injection=Injection.STATE) -> Observer:
    """Contracting enough to be certified."""
    return contracting(functions, order, injection, seed=rng, radius=0.7, lifted=0.05)


@pytest.mark.parametrize(("a", "b"), [(0.5, 0.2), (-0.4, 0.55), (0.0, 0.9), (0.98, -0.015)])
def test_a_scalar_error_shrinks_by_hand(a: float, b: float) -> None:
    found = relift_certificate(scalar(a, b))
    assert found.certified
    # a constant residual, slopes at the corner of the sign of a
    assert found.gain == pytest.approx(1 / (1 - abs(a) - abs(b)), rel=5e-3)
    # Alone from rest, |r+| <= (|a| + |b|) |r| + |b| |q|.
    mismatch = proven_gain(error_system(scalar(a, b)).mismatch())
    assert mismatch == pytest.approx(abs(b) / (1 - abs(a) - abs(b)), rel=5e-3)


@pytest.mark.parametrize(("a", "b"), [(0.5, 0.2), (-0.4, 0.55)])
def test_no_smaller_mismatch_gain_is_proven(a: float, b: float) -> None:
    """The proof itself has to refuse what lies below the exact gain, whatever is proposed."""
    system, exact = error_system(scalar(a, b)).mismatch(), abs(b) / (1 - abs(a) - abs(b))
    for root, t in product(np.geomspace(0.1, 10, 40), np.geomspace(1e-3, 1e3, 40)):
        assert not proven(np.array([[root]]), *system.multiplied(np.array([t]), 0.99 * exact), 0.99 * exact)


@pytest.mark.parametrize(("a", "b"), [(0.5, 0.5), (0.9, -0.2), (1.01, 0.0)])
def test_a_scalar_error_that_may_grow_is_said_to(a: float, b: float) -> None:
    found = relift_certificate(scalar(a, b))
    assert (found.certified, found.status, found.gain) == (False, ReliftStatus.UNSTABLE, None)
    assert "grows" in found.reason


def test_correction_certifies_what_is_unstable_without() -> None:
    assert relift_certificate(scalar(1.02, 0.1, correction=0.6)).gain == pytest.approx(
        np.hypot(1, 0.6) / (1 - 0.42 - 0.1), rel=5e-3
    )


@pytest.mark.parametrize("injection", list(Injection)[:2])
def test_without_lifted_functions_the_gain_is_the_bounded_real_norm(injection: Injection) -> None:
    rng = np.random.default_rng(3)
    observer = random_observer(rng, (), order=5, injection=injection)
    scales = ReliftScales(np.array([2.0, 0.1, 5.0]), np.array([1e-3, 0.3, 1.0]), np.array([0.02]))
    A, B, K = observer.A, observer.B, observer.controller
    into, C = (B if injection is Injection.INPUT else np.eye(3)), np.eye(3)[:1]
    loop = StateSpace(
        np.block([[A - into @ K.D @ C, -into @ K.C], [K.B @ C, K.A]]),
        np.block([[np.diag(scales.residual), -into @ K.D * 0.02], [np.zeros((5, 3)), K.B * 0.02]]),
        np.hstack([np.diag(1 / scales.error), np.zeros((3, 5))]),
        np.zeros((3, 4)),
        0.01,
    )
    found = relift_certificate(observer, scales=scales)
    norm = hinf_norm(loop)
    assert norm < found.gain <= 1.0011 * norm


def test_one_slope_is_certified_up_to_the_circle_criterion_and_not_beyond() -> None:
    """One slope in a symmetric interval: a common Lyapunov matrix exists exactly where the small gain holds."""
    rng = np.random.default_rng(1)
    observer = random_observer(rng, ("sin(a)",), order=2)
    plain = error_system(observer)
    through = hinf_norm(StateSpace(plain.A, plain.L, plain.M, np.zeros((1, 1)), plain.dt))

    def steeper(factor: float) -> ErrorSystem:
        return ErrorSystem(plain.A, plain.L, plain.B, plain.M * factor / through, plain.D, plain.C, plain.dt)

    inside = next(proposals(steeper(0.99)))
    assert proven(inside.root, *steeper(0.99).multiplied(inside.multipliers, inside.gain), inside.gain)
    assert not list(proposals(steeper(1.01)))


def test_brute_force_over_all_slope_sequences_stays_below_the_gain() -> None:
    """Every sequence of corners of a short horizon, the worst disturbance for each by singular values."""
    observer = random_observer(np.random.default_rng(4), ("sin(a)", "sin(2*b)"), order=1)
    found, system = relift_certificate(observer), error_system(observer)
    assert found.gain is not None
    horizon, worst = 5, 0.0
    frozen = [system.frozen(d) for d in product((-1.0, 1.0), repeat=system.L.shape[1])]
    corners = [(one.A, one.B) for one in frozen]
    for sequence in product(range(len(corners)), repeat=horizon - 1):
        blocks = np.zeros((horizon, horizon, 3, 4))
        state = np.zeros((len(system.A), horizon, 4))
        for k in range(horizon):
            A, B = corners[sequence[k - 1]] if k else (np.zeros_like(system.A), system.B)
            state = np.einsum("ij,jab->iab", A, state)
            state[:, k] += B
            blocks[k] = np.moveaxis(np.einsum("zi,iab->zab", system.C, state), 1, 0)
        worst = max(worst, float(np.linalg.norm(blocks.transpose(0, 2, 1, 3).reshape(horizon * 3, -1), 2)))
    assert 0.3 * found.gain < worst <= found.gain


def test_a_product_of_state_and_input_is_covered_inside_its_box() -> None:
    lifting = Lifting(("x",), (), (), ("u",), ("u*x",))
    observer = Observer(
        "bilinear",
        lifting,
        np.array([[0.5]]),
        np.array([[1.0, 0.3]]),
        (0,),
        ("u",),
        gain([[0.0]], 1.0),
        Injection.STATE,
        1.0,
    )
    free = relift_certificate(observer)
    assert free.status is ReliftStatus.UNBOUNDED
    assert "give a box" in free.reason
    assert relift_certificate(observer, box={"u": (-1, 1)}).gain == pytest.approx(1 / (1 - 0.8), rel=5e-3)
    assert relift_certificate(observer, box={"u": (0, 1)}).gain == pytest.approx(1 / (1 - 0.8), rel=5e-3)
    assert relift_certificate(observer, box={"u": (-1, 0)}).gain == pytest.approx(1 / (1 - 0.5), rel=5e-3)


def test_many_slopes_are_certified_by_multipliers() -> None:
    functions = tuple(f"0.2*sin({k}*a)" for k in range(1, 5)) + tuple(f"0.2*cos({k}*b)" for k in range(1, 4))
    observer = random_observer(np.random.default_rng(5), functions, order=2)
    found = relift_certificate(observer)
    assert found.certified
    assert len(found.multipliers) == len(found.channels) == 7
    assert attack(found, observer, steps=20000).share <= 1


@pytest.mark.parametrize("seed", range(2))
def test_an_adversary_comes_close_and_never_exceeds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    observer = random_observer(rng, ("sin(a)", "sin(b + c)")[: 1 + seed], order=seed)
    found = relift_certificate(observer, scales=ReliftScales(np.ones(3), np.array([0.1, 1.0, 2.0]), np.array([0.5])))
    worst = attack(found, observer, steps=20000, seed=seed)
    least = 0.2 if seed else 0.75  # two slopes: the multipliers lose against the corners
    assert least * found.gain < worst.gain <= found.gain
    assert worst.share <= 1
    inputs = rng.standard_normal((len(worst.disturbance) + 1, 6, 1))
    share, _ = attack_running(found, observer, worst.disturbance, rng.standard_normal((6, 3)), inputs, seed=seed)
    assert 0.1 < share <= 1


def test_the_adversary_refutes_a_gain_that_is_too_small() -> None:
    observer = scalar(0.5, 0.2)
    found = relift_certificate(observer)
    wrong = replace(found, gain=0.9 * found.gain)
    assert attack(wrong, observer, steps=5000).share > 1
    constant, rest = np.full((200, 2), [1.0, 0.0]), np.zeros((201, 40, 1))
    assert attack_running(wrong, observer, constant, rest[0], rest, amplitudes=(1e-4, 1e-2))[0] > 1


def test_the_proof_is_exact_at_the_edge() -> None:
    """A = 0, B = C = 1: proven exactly where 1 < P < gamma^2, down to the last bit."""
    one, up = np.ones((1, 1)), np.nextafter(1.0, 2.0)
    rest = (np.zeros((1, 1)), one), one, np.zeros((1, 1))
    assert proven(np.array([[up]]), *rest, float(np.nextafter(up, 2.0)))
    assert not proven(one, *rest, float(np.nextafter(up, 2.0)))  # P = C'C
    assert not proven(np.array([[up]]), *rest, float(up))  # gamma^2 = P
    assert not proven(np.array([[np.nan]]), *rest, 2.0)


@pytest.mark.parametrize(("share", "definite"), [(0.95, True), (0.9999, True), (1.0, False), (1.0001, False)])
def test_definiteness_of_large_integers_is_that_of_their_determinant(share: float, definite: bool) -> None:
    """Diagonal entries of very different size, and a correlation on either side of one."""
    sizes = [1 << 400, 1 << 201, 3]
    off = int(share * (1 << 60)) * isqrt(sizes[0] * sizes[1]) >> 60
    F = np.array([[sizes[0], off, 0], [off, sizes[1], 1], [0, 1, sizes[2]]], dtype=object)
    # the root is rounded down, by less than can be told
    assert (sizes[0] * sizes[1] > off**2) == (definite or share == 1)
    assert positive(F) == definite


def test_nothing_is_proven_where_rounding_grows() -> None:
    """Of a model of states that are multiples of one another: stable, and its powers overflow."""
    A = np.array([[-387206.46247167, 387207.40067715], [-387206.02437448, 387206.96257989]])
    system = ErrorSystem(A, np.zeros((2, 0)), np.eye(2), np.zeros((0, 2)), np.zeros((0, 2)), np.eye(2), 0.1)
    assert system.frozen(np.zeros(0)).is_stable()
    assert proven_gain(system) == np.inf


def test_a_certificate_survives_saving(tmp_path) -> None:  # type: ignore[no-untyped-def]
    found = relift_certificate(scalar(0.5, 0.2), box={"x": (-1, 2)})
    found.save(tmp_path)
    loaded = ReliftCertificate.load(tmp_path)
    for name in ReliftCertificate.__dataclass_fields__:
        if name not in ("scales", "box"):
            np.testing.assert_array_equal(getattr(loaded, name), getattr(found, name))
    parts = loaded.system(scalar(0.5, 0.2)).multiplied(loaded.multipliers, loaded.gain)
    assert proven(loaded.root, *parts, loaded.gain)


@pytest.mark.parametrize(("seed", "size"), [(0, 0.1), (1, 0.005), (2, 0.01), (3, 2.0)])
def test_multipliers_are_nearly_the_best_of_a_direct_search(seed: int, size: float) -> None:
    """Squared gain that multipliers prove over the grid, by a Schur complement, minimised by Nelder and Mead from many places."""
    rng, width = np.random.default_rng(seed), 2
    H = rng.standard_normal((30, 4, 4)) + 1j * rng.standard_normal((30, 4, 4))
    H *= np.where(np.arange(4) < width, size, 3.0)[:, None] * np.array([1.0, 40.0, 1.0, 1.0])
    H[:, :, 0] *= 0.05  # slopes of different weight

    def squared(log: np.ndarray) -> float:
        t = np.concatenate([np.exp(log), np.ones(2)])
        F = np.diag(np.concatenate([np.exp(log), np.zeros(2)])) - np.conj(np.swapaxes(H, 1, 2)) @ (t[:, None] * H)
        if np.linalg.eigvalsh(F[:, :width, :width])[:, 0].min() <= 0:
            return 1e30
        schur = F[:, width:, width:] - F[:, width:, :width] @ np.linalg.solve(
            F[:, :width, :width], F[:, :width, width:]
        )
        return -float(np.linalg.eigvalsh(schur)[:, 0].min())

    starts = [np.array([a, a + b]) for a in np.linspace(-10, 14, 25) for b in np.linspace(-12, 12, 25)]
    best = min(minimize(squared, start, method="Nelder-Mead").fun for start in sorted(starts, key=squared)[:3])
    found = best_multipliers(H, width)
    assert (found is None) == (best == 1e30)
    if found is not None:
        assert squared(np.log(found)) <= 1.001 * best
