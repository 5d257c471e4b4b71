"""The judging drive's physics: energy, statics, and its linear limit against SciPy."""

import compliant_drive as drive
import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

N = 3


def parameters(**fixed):
    """Parameters of a few drives, some of them fixed."""
    return drive.draw(seed=4, n_units=N, spread=2.0) | {name: np.full(N, float(value)) for name, value in fixed.items()}


@pytest.mark.parametrize("loaded", [0.0, 1.0])
def test_energy_is_what_enters_less_what_leaves(loaded):
    """Kinematic error, hysteresis, gravity and friction included; what the integrator leaves out shrinks with its step."""
    missing = []
    for finer in (1, 4):
        physics = drive.Physics(
            parameters(error_1=2e-3), np.full(N, loaded), np.array([0.3, 1.0, -2.0]), drive.PERIOD_S / 5 / finer
        )
        start, balance, turned = physics.energy(), 0.0, 0.0
        for k in range(2000 * finer):
            powers = physics.advance(np.full(N, 0.6 * np.sign(np.sin(8 * k * physics.step_s + 0.5))))
            balance = balance + physics.step_s * (powers["in"] - powers["out"])
            turned = turned + physics.step_s * np.abs(powers["in"])
        missing.append(np.abs(physics.energy() - start - balance) / turned)
    assert np.all(missing[0] < 0.02)
    assert np.all(missing[1] < 0.4 * missing[0])


def test_without_friction_error_and_gravity_it_is_a_linear_two_mass_system():
    p = parameters(coulomb=0, stribeck=0, hysteresis_torque=1e-12, error_1=0, error_2=0)
    physics = drive.Physics(p, np.zeros(N), np.zeros(N), 1e-5)
    time, voltage = 1e-5 * np.arange(8000), np.where(np.arange(8000) < 4000, 0.5, -0.5)
    found = []
    for v in voltage:
        found.append([physics.q, physics.w, physics.wl, physics.i])
        physics.advance(np.full(N, v))
    for row in range(N):
        Jm, Jl, k, c, b, Kt, R, L = (
            float(p[n][row])
            for n in (
                "motor_inertia",
                "link_inertia",
                "stiffness",
                "damping",
                "viscous",
                "torque_constant",
                "resistance",
                "inductance",
            )
        )
        A = np.zeros((5, 5))  # q, w, q_l, w_l, i
        A[0, 1] = A[2, 3] = 1
        A[1] = np.array([-k, -c - b, k, c, Kt]) / Jm
        A[3] = np.array([k, c, -k, -c, 0]) / Jl
        A[4] = np.array([0, -Kt / drive.SUPPLY_W, 0, 0, -R]) / L
        _, y, _ = lsim(
            StateSpace(A, np.array([[0], [0], [0], [0], [1 / L]]), np.eye(5)[[0, 1, 3, 4]], np.zeros((4, 1))),
            voltage,
            time,
            interp=False,
        )
        difference = np.array(found)[..., row] - y
        assert np.all(np.abs(difference).max(axis=0) < 5e-3 * np.abs(y).max(axis=0))


def test_a_population_is_one_for_a_study():
    population, _ = drive.simulate(n_units=1, n_episodes=1, seconds=2.0, seed=3)
    states, inputs = population.read_parts(population.episodes[0])
    true = population.read_with_truths(population.episodes[0])[1][:, 0]
    travelled = np.concatenate([[0.0], np.cumsum(true[1:] + true[:-1])]) * drive.PERIOD_S / 2
    assert np.abs(states[:, 0] - states[0, 0] - travelled).max() < 1e-3 * np.ptp(states[:, 0])
    assert np.abs(states[:, 0] - inputs[:, 0]).max() < 0.05
