"""Mixed synthesis: the inequalities against Riccati optima and recomputed norms, on general plants and on drive-like observers."""

import re

import numpy as np
import pytest
from scipy.linalg import expm

from kros.core import StateSpace, SynthesisError, block_diagonal, gain, h2_norm, hinf_norm
from kros.synthesis import GeneralizedPlant, Injection, ObserverProblem, h2, mixed
from kros.synthesis.certificate import certify
from kros.synthesis.mixed_optimal import part
from kros.synthesis.reduction import truncate

DT = 1e-3


def two_channel(rng, n=3, size2=0.3):
    """A random stable plant with w = (w1, noise | w2), z = (performance, penalty | z2)."""
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    B1 = np.hstack([rng.standard_normal((n, 1)), np.zeros((n, 1)), size2 * rng.standard_normal((n, 1))])
    C1 = np.vstack([rng.standard_normal((1, n)), np.zeros((1, n)), size2 * rng.standard_normal((1, n))])
    return GeneralizedPlant(
        A,
        B1,
        rng.standard_normal((n, 1)),
        C1,
        rng.standard_normal((1, n)),
        np.zeros((3, 3)),
        [[0.0], [0.5], [0.0]],
        [[0.0, 0.5, 0.0]],
        [[0.0]],
        1.0,
        n_w1=2,
        n_z1=2,
    )


def drive_problem(seed, injection, order):
    rng = np.random.default_rng(seed)
    kt, b, kp, kv, wc = np.array([60, 3, 12, 3, 600]) * np.exp(0.1 * rng.standard_normal(5))
    A = np.array([[0, 1, 0, 0], [0, -b, kt, 2], [-wc * kv * kp, -wc * kv, -wc, 0], [0.5, 1, 0, -30]])
    B = np.array([[0, 0], [0, 0], [wc * kv * kp, wc * kv], [0, 0]])
    M = expm(DT * np.block([[A, B], [np.zeros((2, 6))]]))

    def lag(low, high, corner_hz):
        a = np.exp(-2 * np.pi * corner_hz * DT)
        d, c = np.linalg.solve([[1, 1 / (1 - a)], [1, -1 / (1 + a)]], [low, high])
        return StateSpace([[a]], [[1.0]], [[c]], [[d]], DT)

    def channel():
        system = lag(10 ** rng.uniform(-2.5, -1.5), 10 ** rng.uniform(-0.9, -0.3), 10 ** rng.uniform(0.5, 2))
        for _ in range(order - 1):
            system = system @ lag(1, 10 ** rng.uniform(-0.2, 0.2), 10 ** rng.uniform(0, 2))
        return system

    return ObserverProblem(
        nominal=StateSpace(M[:4, :4], M[:4, 4:], np.eye(4), np.zeros((4, 2)), DT),
        C=np.eye(4)[:1],
        W_L=block_diagonal([channel(), channel()]),
        W_R=gain(np.eye(2), DT),
        input_scale=np.array([3.0, 3.0]),
        output_scale=np.array([3.0, 3.0, 0.5, 1.0]),
        noise=np.array([1e-5]),
        n_original=3,
        injection=injection,
    )


def value_of(found):
    """Value of the inequalities, from the note."""
    (note,) = (re.search(r"Value of the inequalities ([0-9.e+-]+)", n) for n in found.notes if "Value of the inequalities" in n)
    return float(note.group(1))


def test_inactive_constraint_gives_the_riccati_optimum():
    for seed in range(2):
        plant = two_channel(np.random.default_rng(seed), size2=1e-4)
        found = mixed(plant, scalings=(1.0,))
        optimum = h2(plant.channel(plant.rows(1), plant.columns(1)))
        assert found.lower_bound == pytest.approx(optimum.h2_norm)
        assert optimum.h2_norm * (1 - 1e-9) <= found.h2_norm <= optimum.h2_norm * 1.01
        assert found.gap_percent < 1


def test_active_constraint_is_met_and_recomputed():
    for seed in (10, 12):
        plant = two_channel(np.random.default_rng(seed))
        free = h2(plant.channel(plant.rows(1), plant.columns(1)))
        peak = hinf_norm(part(plant, plant.close(free.controller), 2))
        gamma = 0.9 * peak
        found = mixed(plant, gamma=gamma, scalings=(4.0, 16.0))
        closed = plant.close(found.controller)
        assert closed.is_stable()
        assert found.hinf_norm == pytest.approx(hinf_norm(part(plant, closed, 2)))
        assert found.hinf_norm < gamma
        assert found.h2_norm == pytest.approx(h2_norm(part(plant, closed, 1)))
        assert found.h2_norm >= free.h2_norm * (1 - 1e-9)
        assert found.h2_norm <= value_of(found) * (1 + 1e-3), "the inequalities bound the norm from above"


def test_scaling_of_the_channel_helps():
    # With one Lyapunov matrix and no scaling these constraints look infeasible; scaled, they cost a few percent.
    for seed in (10, 11):
        plant = two_channel(np.random.default_rng(seed))
        free = h2(plant.channel(plant.rows(1), plant.columns(1)))
        gamma = 0.95 * hinf_norm(part(plant, plant.close(free.controller), 2))
        with pytest.raises(SynthesisError, match="infeasible"):
            mixed(plant, gamma=gamma, scalings=(1.0,))
        found = mixed(plant, gamma=gamma)
        assert found.gap_percent < 5
        assert found.hinf_norm < gamma


def test_feedthrough_is_absorbed():
    plant = two_channel(np.random.default_rng(3), size2=1e-4)
    with_d22 = GeneralizedPlant(*(getattr(plant, x) for x in ("A", "B1", "B2", "C1", "C2", "D11", "D12", "D21")), [[0.3]], 1.0, 2, 2)
    assert mixed(with_d22, scalings=(1.0,)).h2_norm == pytest.approx(mixed(plant, scalings=(1.0,)).h2_norm, rel=1e-3)


@pytest.mark.parametrize(("seed", "order", "injection"), [(3, 5, Injection.INPUT), (3, 3, Injection.INPUT), (5, 1, Injection.STATE)])
def test_drive_like_observers_are_solved_and_certified(seed, order, injection):
    case = drive_problem(seed, injection, order)
    found = mixed(case)
    plant = case.mixed_plant()
    assert plant.sizes[0] == 4 + 2 * order
    closed = plant.close(case.to_scaled(found.controller))
    assert closed.is_stable()
    assert found.h2_norm == pytest.approx(h2_norm(part(plant, closed, 1)), rel=1e-4)
    assert found.hinf_norm == pytest.approx(hinf_norm(case.W_R @ case.W_L), rel=1e-5)  # T22 does not contain K
    assert found.worst_case_h2 == pytest.approx(certify(case, found.controller)[0])
    nothing = gain(np.zeros((2 if injection is Injection.INPUT else 4, 1)), DT)
    assert found.worst_case_h2 < certify(case, nothing)[0]


def test_shrinking_the_channel_of_an_observer_only_undoes_the_correction():
    case = drive_problem(0, Injection.INPUT, 1)
    plain, shrunk = mixed(case), mixed(case, scalings=(1e-2,))
    nothing = certify(case, gain(np.zeros((2, 1)), DT))[0]
    assert plain.worst_case_h2 < shrunk.worst_case_h2 <= nothing * 1.01
    assert shrunk.h2_norm < plain.h2_norm  # T11 holds the noise alone: no correction is its optimum


def test_mixed_plant_is_the_published_one_with_noise_and_penalty():
    from kros.synthesis.paper_plant import reduced_plant

    case = drive_problem(1, Injection.INPUT, 2)
    A, B, C, W_p = case.scaled
    nominal = StateSpace(A, B, np.eye(4), np.zeros((4, 2)), DT)
    published = reduced_plant(nominal, C, gain(W_p, DT), gain(np.eye(2), DT), case.W_L)
    freqs = np.geomspace(0.01, 500, 30)
    ours, theirs = case.mixed_plant().open_loop().frequency_response(freqs), published.open_loop().frequency_response(freqs)
    rows, columns = np.r_[0:3, 5:7, 7], np.r_[0:2, 3:5, 5:7]  # without penalty outputs and noise inputs
    assert ours[:, rows][:, :, columns] == pytest.approx(theirs, abs=1e-8 * np.abs(theirs).max())


def test_mixed_plant_with_dynamic_weights_on_both_sides():
    base = drive_problem(2, Injection.INPUT, 1)
    lagged = block_diagonal([StateSpace([[0.5]], [[1.0]], [[0.2]], [[0.3]], DT)] * 2)
    case = ObserverProblem(base.nominal, base.C, base.W_L, lagged, base.input_scale, base.output_scale, base.noise, 3, W_u=lagged)
    plant = case.mixed_plant()
    A, B, _, W_p = case.scaled
    freqs = np.geomspace(0.01, 500, 20)
    found = plant.open_loop().frequency_response(freqs)
    right, left = lagged.frequency_response(freqs), base.W_L.frequency_response(freqs)
    z = np.exp(2j * np.pi * freqs * DT)[:, None, None]
    path = W_p @ np.linalg.solve(z * np.eye(4) - A, B[None] + 0j)
    assert found[:, :3, 3:5] == pytest.approx(path @ left, rel=1e-6, abs=1e-9)
    assert found[:, -3:-1, :2] == pytest.approx(right @ right, abs=1e-10)  # W_R W_u
    assert found[:, -3:-1, 3:5] == pytest.approx(right @ left, abs=1e-10)  # W_R W_L
    assert not np.abs(found[:, :3, :3]).any()


def test_truncation_error_is_within_its_bound():
    plant = drive_problem(4, Injection.INPUT, 5).mixed_plant()
    small, tail = truncate(plant, 8)
    full = plant.open_loop()
    difference = StateSpace(
        block_diagonal([full, small.open_loop()]).A,
        np.vstack([full.B, small.open_loop().B]),
        np.hstack([full.C, -small.open_loop().C]),
        full.D - small.open_loop().D,
        DT,
    )
    assert small.sizes[0] <= 8
    assert hinf_norm(difference) <= 2 * tail * hinf_norm(full) * 1.01 + 1e-9 * hinf_norm(full)
