"""Structured singular value against published examples, SLICOT, exhaustive search and exact cases; D-K iteration against a published design."""

import numpy as np
import pytest
from scipy.signal import cont2discrete

from kros.core import ConfigError, DimensionError, StateSpace, SynthesisError, hinf_norm
from kros.synthesis import Block, GeneralizedPlant, dk_iteration, hinf, mu_bounds, mu_lower, mu_upper
from kros.synthesis.structured.blocks import Structure
from kros.synthesis.structured.dk import scale
from kros.synthesis.structured.dk_scalings import RationalScalings, log_magnitude
from kros.synthesis.structured.scalings import scalings

SCALAR = Block.scalar()


def complex_normal(rng, *shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def four_scalars():
    """A matrix whose bounds are known to differ (P. Parrilo's example in the manual of SOSTOOLS, after Packard and Doyle 1993)."""
    alpha, beta = 3 + np.sqrt(3), np.sqrt(3) - 1
    a, b, d, f = np.sqrt(2 / alpha), 1 / np.sqrt(alpha), -np.sqrt(beta / alpha), (1 + 1j) * np.sqrt(1 / (alpha * beta))
    U = np.array([[a, 0], [b, b], [b, 1j * b], [d, f]])
    V = np.array([[0, a], [b, -b], [b, -1j * b], [-1j * f, -d]])
    return U @ V.conj().T


def test_published_values():
    M = [[2, 2], [-1, -1]]  # Skogestad and Postlethwaite, example 8.5
    assert mu_upper(M, [SCALAR, SCALAR]) == pytest.approx(3.0, rel=1e-9)
    assert mu_upper(M, [Block.full(2)]) == pytest.approx(np.sqrt(10), rel=1e-9)
    assert mu_lower(M, [SCALAR, SCALAR])[0] == pytest.approx(3.0, rel=1e-9)
    assert mu_upper(four_scalars(), [SCALAR] * 4) == pytest.approx(1.0, rel=1e-7)
    # mu is at most 0.8724 by sums of squares: demo 5 of SOSTOOLS
    assert mu_lower(four_scalars(), [SCALAR] * 4)[0] == pytest.approx(0.8723, abs=1e-4)


def test_slicot_agrees():
    M = complex_normal(np.random.default_rng(0), 2, 6, 6)
    # ab13md of slycot 0.7.1 on the same matrices
    assert mu_upper(M, [SCALAR] * 6) == pytest.approx([4.557556880243582, 5.149724631077613], rel=1e-6)
    assert mu_upper(M, [Block.full(2)] * 3) == pytest.approx([4.838485964799536, 5.788884113503106], rel=1e-6)


def test_the_scalings_returned_attain_the_bound():
    rng = np.random.default_rng(5)
    structure = Structure.of([Block.scalar(2), Block.full(2), SCALAR])
    M = complex_normal(rng, 10, 5, 5)
    found = scalings(M, structure)
    gap = found.upper[:, None, None] ** 2 * found.X_R - np.conj(np.swapaxes(M, -1, -2)) @ found.X_L @ M
    size = np.linalg.norm(found.X_R, 2, axis=(-2, -1)) * found.upper**2
    assert np.all(np.linalg.eigvalsh(gap)[:, 0] >= -1e-9 * size)
    Delta = np.zeros((5, 5), complex)
    Delta[:2, :2], Delta[2:4, 2:4], Delta[4, 4] = 2j * np.eye(2), complex_normal(rng, 2, 2), 3.0
    assert found.X_R @ Delta == pytest.approx(Delta @ found.X_L, rel=1e-9, abs=1e-12), "they commute with the structure"


def test_two_scalars_by_exhaustive_search():
    rng = np.random.default_rng(1)
    for M in complex_normal(rng, 5, 2, 2):
        phases = np.exp(1j * np.linspace(0, 2 * np.pi, 20001))
        # Delta = diag(1, e^{j phi}) up to a common phase; the largest spectral radius over phi is mu
        trace, det = M[0, 0] + M[1, 1] * phases, (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]) * phases
        root = np.sqrt(trace**2 - 4 * det)
        exact = np.maximum(np.abs(trace + root), np.abs(trace - root)).max() / 2
        assert mu_upper(M, [SCALAR] * 2) == pytest.approx(exact, rel=1e-6)
        assert mu_lower(M, [SCALAR] * 2)[0] == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize(
    "blocks",
    [
        [Block.full(2), Block.full(4)],
        [Block.full(2), Block.full(2), Block.full(2)],
        [Block.full(2, 3), Block.full(4, 3)],
        [Block.scalar(6)],
        [Block.full(6)],
    ],
)
def test_bounds_meet_where_theory_says_so(blocks):
    M = complex_normal(np.random.default_rng(2), 12, 6, 6)
    upper, (lower, Delta) = mu_upper(M, blocks), mu_lower(M, blocks)
    assert np.all(lower <= upper * (1 + 1e-9))
    assert np.mean(lower > upper * (1 - 1e-4)) > 0.8, "the power iteration need not reach every optimum"
    assert np.linalg.norm(Delta, 2, axis=(-2, -1)) == pytest.approx(1.0)
    singular = np.eye(6) - np.exp(-1j * np.angle(leading(M @ Delta)))[:, None, None] * (M @ Delta) / lower[:, None, None]
    assert np.abs(np.linalg.det(singular)).max() < 1e-6
    if blocks == [Block.scalar(6)]:
        assert upper == pytest.approx(np.abs(leading(M)), rel=1e-5)
    if blocks == [Block.full(6)]:
        assert upper == pytest.approx(np.linalg.norm(M, 2, axis=(-2, -1)))


def leading(M):
    values = np.linalg.eigvals(M)
    return np.take_along_axis(values, np.argmax(np.abs(values), axis=-1)[:, None], axis=-1)[:, 0]


def test_mixed_blocks_lie_between_their_bounds_and_scalings_do_not_matter():
    rng = np.random.default_rng(3)
    blocks = [Block.scalar(2), Block.full(2), SCALAR, SCALAR]
    M = complex_normal(rng, 8, 6, 6)
    upper = mu_upper(M, blocks)
    assert np.all(mu_lower(M, blocks)[0] <= upper * (1 + 1e-9))
    assert np.all(upper <= np.linalg.norm(M, 2, axis=(-2, -1)) * (1 + 1e-9))
    T = np.eye(6, dtype=complex)
    T[:2, :2], T[2:4, 2:4], T[4, 4], T[5, 5] = complex_normal(rng, 2, 2), 30 * np.eye(2), 0.01, 3j
    assert mu_upper(T @ M @ np.linalg.inv(T), blocks) == pytest.approx(upper, rel=1e-5)


def test_a_matrix_without_coupling_and_a_zero_one():
    M = np.array([[2.0, 1e3], [0.0, 1.0]])
    assert mu_upper(M, [SCALAR, SCALAR]) == pytest.approx(2.0, rel=1e-2)  # the infimum is not attained
    assert mu_upper(np.zeros((2, 2)), [SCALAR, SCALAR]) == 0.0


def test_a_peak_between_the_points_is_found():
    angle, radius = 0.3, 1 - 1e-4
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    system = StateSpace(A, [[1.0], [0.0]], [[1.0, 0.0]], [[0.0]], 0.01)
    found = mu_bounds(system, [SCALAR], np.geomspace(0.1, 50, 60))
    assert found.peak == pytest.approx(hinf_norm(system), rel=1e-3)
    assert found.peak_hz == pytest.approx(angle / (2 * np.pi * 0.01), rel=1e-3)
    assert found.peak_lower == pytest.approx(found.peak)


def lightly_damped(rng, damping, dt):
    """Two resonances between the points of any grid, four signals."""
    angles = rng.uniform(0.1, 2.5, 2)
    poles = -damping * angles + 1j * angles
    A = np.zeros((4, 4))
    for k, s in enumerate(np.exp(poles) if dt > 0 else poles):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[s.real, s.imag], [-s.imag, s.real]]
    return StateSpace(A, rng.standard_normal((4, 4)), rng.standard_normal((4, 4)), 0.1 * np.eye(4), dt), angles


@pytest.mark.parametrize("dt", [0.0, 0.01])
@pytest.mark.parametrize("damping", [1e-2, 1e-4, 1e-7])
def test_peaks_of_lightly_damped_poles_are_found_and_bounded(damping, dt):
    rng = np.random.default_rng(20)
    for blocks in ([SCALAR] * 4, [Block.full(2), Block.scalar(2)]):
        system, angles = lightly_damped(rng, damping, dt)
        found = mu_bounds(system, blocks)
        near = (angles[:, None] * (1 + damping * np.linspace(-5, 5, 41))).ravel() / (2 * np.pi * (dt or 1.0))
        everywhere = np.concatenate([near, np.geomspace(near.min() / 100, 0.5 / dt if dt > 0 else 10 * near.max(), 60)])
        truth = mu_upper(system.frequency_response(everywhere), blocks).max()
        assert found.peak >= truth * (1 - 1e-3)
        assert truth * (1 - 1e-9) <= found.everywhere <= 1.02 * found.peak
        assert found.peak_lower <= found.everywhere


def test_a_peak_beside_a_given_grid_is_found():
    # the grid ends below the resonance, so that only the bound between and beyond its points can tell of it
    system, angles = lightly_damped(np.random.default_rng(21), 1e-5, 0.0)
    blocks = [Block.full(2), Block.full(2)]
    found = mu_bounds(system, blocks, np.geomspace(1e-3, 0.5, 20) * angles.min() / (2 * np.pi))
    truth = mu_upper(system.frequency_response(angles / (2 * np.pi)), blocks).max()
    assert found.peak >= 0.99 * truth
    assert truth <= found.everywhere <= 1.1 * truth


def test_what_does_not_fit_is_refused():
    with pytest.raises(DimensionError, match="need a matrix of"):
        mu_upper(np.eye(3), [SCALAR, SCALAR])
    with pytest.raises(DimensionError, match="at least one block"):
        mu_upper(np.eye(3), [])
    with pytest.raises(DimensionError, match="repeated scalar"):
        Block(2, 3, repeated=True)
    with pytest.raises(DimensionError, match="finite"):
        mu_upper([[np.nan]], [SCALAR])
    with pytest.raises(SynthesisError, match="unstable"):
        mu_bounds(StateSpace([[1.1]], [[1.0]], [[1.0]], [[0.0]], 1.0), [SCALAR])


def distillation(dt=0.1):
    """Skogestad and Postlethwaite, section 8.12.4: an ill-conditioned column, uncertain gains; time in minutes, by Tustin's map."""
    G, eye, zero = np.array([[87.8, -86.4], [108.2, -109.6]]) / 75, np.eye(2), np.zeros((2, 2))
    # states: column, w_I = 2 - 3.6 / (s + 2), w_P = 0.5 + 0.05 / (s + 1e-5)
    A = np.block([[-eye / 75, zero, zero], [zero, -2 * eye, zero], [eye, zero, -1e-5 * eye]])
    B = np.block([[G, zero, G], [zero, zero, eye], [zero, eye, zero]])
    C = np.block([[zero, -3.6 * eye, zero], [0.5 * eye, zero, 0.05 * eye], [-eye, zero, zero]])
    D = np.block([[zero, zero, 2 * eye], [zero, 0.5 * eye, zero], [zero, -eye, zero]])
    A, B, C, D, _ = cont2discrete((A, B, C, D), dt, "bilinear")
    return GeneralizedPlant(A, B[:, :4], B[:, 4:], C[:4], C[4:], D[:4, :4], D[:4, 4:], D[4:, :4], D[4:, 4:], dt)


def test_published_design_of_a_distillation_column():
    plant, blocks = distillation(), [SCALAR, SCALAR, Block.full(2)]
    grid = np.geomspace(1e-5, 4.9, 35)
    first = hinf(plant, tolerance=1e-4)
    # scripts of the book (Sec8_124): norm 1.1823 and mu 1.1818 at first, 1.0238 after a second round with scalings of order four; 0.974 with those of Lundström
    assert first.hinf_norm == pytest.approx(1.1823, rel=5e-3)
    found = dk_iteration(plant, blocks, iterations=1, freqs_hz=grid, start=first)
    before, peak = (float(p) for p in found.notes[0].split(":")[1].split(";")[0].split(","))
    assert before == pytest.approx(1.1818, rel=5e-3)
    assert 0.974 < peak < 1.06
    assert peak == pytest.approx(mu_upper(plant.close(found.controller).frequency_response(grid), blocks).max(), rel=2e-2)
    everywhere = float(found.notes[2].split()[3])
    assert peak <= everywhere * (1 + 1e-3)
    assert everywhere < 1.08
    assert found.hinf_norm == pytest.approx(hinf_norm(plant.close(found.controller)))


def test_the_start_is_kept_when_nothing_is_better():
    # one full block: mu is the norm, and hinf is optimal already
    plant = GeneralizedPlant(
        [[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]], [[0]], 1.0
    )
    start = hinf(plant)
    found = dk_iteration(plant, [Block.full(2)], iterations=2, freqs_hz=np.geomspace(1e-4, 0.5, 30))
    assert found.hinf_norm <= start.hinf_norm * (1 + 1e-4)
    with pytest.raises(ConfigError, match="max_order = 3"):
        dk_iteration(plant, [Block.full(2)], max_order=3)


def test_rational_scalings_are_what_their_parameters_say():
    rng = np.random.default_rng(4)
    structure_sections = rng.normal(size=(1, 2, 4)) - 1
    rational = RationalScalings(Structure.of([Block.full(1), Block.full(1)]), np.array([0.3]), structure_sections, 0.1)
    left, right = rational.systems()
    freqs = np.array([0.0, 0.01, 0.3, 2.0, 4.9])
    magnitude = np.abs(left.frequency_response(freqs)[:, 0, 0])
    assert magnitude == pytest.approx(np.exp(0.3 + log_magnitude(structure_sections, freqs, 0.1)[0][0]), rel=1e-9)
    assert left.is_stable()
    inverse = np.linalg.inv(left.D)
    assert np.abs(np.linalg.eigvals(left.A - left.B @ inverse @ left.C)).max() < 1
    plant = distillation()
    same = scale(plant, *RationalScalings(Structure.of([SCALAR, SCALAR, Block.full(2)]), np.zeros(2), np.zeros((2, 0, 4)), 0.1).systems())
    assert same.open_loop().frequency_response([0.01]) == pytest.approx(plant.open_loop().frequency_response([0.01]), rel=1e-6, abs=1e-9)
    assert right.D.shape == (2, 2)
