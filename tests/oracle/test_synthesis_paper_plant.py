"""The three facts about the published generalized plant (37)-(39)."""

import numpy as np
import pytest
from paper_plant import paper_plant, reduced_plant

from kros.core import StateSpace, SynthesisError, block_diagonal, gain, h2_norm, hinf_norm
from kros.synthesis import GeneralizedPlant, h2
from kros.synthesis.assumptions import Assumption, h2_violations

DT = 1e-3


def example(seed=0, static_u=True):
    """A random stable model of the paper's sizes: four lifted states, two inputs, one measured output, ten states of W_D."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    nominal = StateSpace(A, rng.standard_normal((4, 2)), np.eye(4), np.zeros((4, 2)), DT)

    def weight(order):
        poles = rng.uniform(-0.9, 0.9, order)
        return StateSpace(np.diag(poles), np.ones((order, 1)), 0.1 * rng.uniform(0.5, 1, (1, order)), [[0.1]], DT)

    # Entrywise weight as in the paper, orders 1, 3, 3, 3, in a minimal realisation.
    w = [weight(k) for k in (1, 3, 3, 3)]
    stack = block_diagonal(w)
    left, right = np.array([[1.0, 1, 0, 0], [0, 0, 1, 1]]), np.array([[1.0, 0], [0, 1], [1, 0], [0, 1]])
    W_D = StateSpace(stack.A, stack.B @ right, left @ stack.C, left @ stack.D @ right, DT)
    W_u = gain(np.eye(2), DT) if static_u else block_diagonal([weight(1), weight(1)])
    W_p = gain(np.diag([1.0, 1, 1, 0])[:3], DT)
    return nominal, np.eye(4)[:1], W_p, W_u, W_D


def reach(A, B):
    """Rank of the controllability matrix by the staircase of an orthonormal basis (no powers)."""
    basis = np.zeros((len(A), 0))
    block = B
    while True:
        block = block - basis @ (basis.T @ block)
        block = block - basis @ (basis.T @ block)
        U, s, _ = np.linalg.svd(block, full_matrices=False)
        new = U[:, s > 1e-8]
        if not new.shape[1]:
            return basis.shape[1]
        basis = np.hstack([basis, new])
        block = A @ new


def random_stabilising(plant, rng):
    """A random dynamic controller that keeps the loop stable."""
    _, _, n_u, _, n_y = plant.sizes
    for scale in (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001):
        K = StateSpace(
            np.diag(rng.uniform(-0.5, 0.5, 2)),
            rng.standard_normal((2, n_y)),
            scale * rng.standard_normal((n_u, 2)),
            scale * rng.standard_normal((n_u, n_y)),
            DT,
        )
        if plant.close(K).is_stable():
            return K
    raise AssertionError("no stabilising controller found; the plant itself should be stable")


@pytest.mark.parametrize("static_u", [True, False])
def test_reduced_plant_has_the_same_transfer_matrices(static_u):
    parts = example(static_u=static_u)
    full, reduced = paper_plant(*parts), reduced_plant(*parts)
    freqs = np.geomspace(0.01, 500, 60)
    assert full.sizes[0] == (18 if static_u else 20)
    assert reduced.sizes[0] == full.sizes[0] - 4
    assert reduced.open_loop().frequency_response(freqs) == pytest.approx(full.open_loop().frequency_response(freqs), abs=1e-10)


def test_fact_one_not_minimal():
    full, reduced = paper_plant(*example()), reduced_plant(*example())
    for plant, expected in ((full, False), (reduced, True)):
        system = plant.open_loop()
        minimal = reach(system.A, system.B) == system.n_states and reach(system.A.T, system.C.T) == system.n_states
        assert minimal is expected
    assert reach(full.open_loop().A.T, full.open_loop().C.T) == 14


def test_fact_two_singular():
    plant = reduced_plant(*example())
    labels = {v.assumption for v in h2_violations(plant)}
    assert {Assumption.CONTROL_PENALTY, Assumption.MEASUREMENT_NOISE} <= labels
    with pytest.raises(SynthesisError, match=r"A2a: D12 of full column rank .*penalty.*A2b: D21 of full row rank .*noise"):
        h2(plant)


@pytest.mark.parametrize("build", [paper_plant, reduced_plant])
def test_fact_three_degenerate(build):
    plant = build(*example())
    rng = np.random.default_rng(3)
    freqs = np.geomspace(0.01, 500, 40)
    responses = []
    for _ in range(5):
        closed = plant.close(random_stabilising(plant, rng))
        assert closed.is_stable()
        responses.append(closed.frequency_response(freqs))
        T11 = StateSpace(closed.A, closed.B[:, :2], closed.C[:3], closed.D[:3, :2], DT)
        assert hinf_norm(T11) < 1e-9
        assert h2_norm(T11) < 1e-6  # the square is computed, so half the digits are left
    for other in responses[1:]:
        assert other[:, 3:, 2:] == pytest.approx(responses[0][:, 3:, 2:], abs=1e-10)  # T22
    assert np.abs(responses[1][:, :3, 2:] - responses[0][:, :3, 2:]).max() > 1e-3  # T12 does depend on K


def test_close_solves_the_algebraic_loop():
    rng = np.random.default_rng(8)
    plant = GeneralizedPlant(
        *(rng.standard_normal(s) for s in ((3, 3), (3, 2), (3, 1), (2, 3), (2, 3), (2, 2), (2, 1), (2, 2))),
        0.3 * rng.standard_normal((2, 1)),
        1.0,
    )
    K = StateSpace(rng.standard_normal((2, 2)), rng.standard_normal((2, 2)), rng.standard_normal((1, 2)), rng.standard_normal((1, 2)), 1.0)
    freqs = np.array([0.01, 0.1, 0.37])
    P, k = plant.open_loop().frequency_response(freqs), K.frequency_response(freqs)
    P11, P12, P21, P22 = P[:, :2, :2], P[:, :2, 2:], P[:, 2:, :2], P[:, 2:, 2:]
    expected = P11 + P12 @ k @ np.linalg.solve(np.eye(2) - P22 @ k, P21)
    assert plant.close(K).frequency_response(freqs) == pytest.approx(expected)
