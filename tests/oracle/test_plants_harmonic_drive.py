"""The simulated drives against physics written down a second time, and calibration against known truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kros.plants import HarmonicDrivePopulation
from kros.plants.harmonic_drive.dynamics import VELOCITY_POLE, DriveParameters, Physics
from kros.plants.harmonic_drive.population import MAX_SPEED

PERIOD = 1e-3
TURN = 20  # samples of a motor revolution at full speed
SETTLE = 250  # samples


def drives_of(seed, n_units, spread=1.0):
    return DriveParameters(**HarmonicDrivePopulation(n_units=n_units, seed=seed, spread=spread).units()[1])


@pytest.fixture(scope="module", params=["stiff", "soft"])
def drives(request):
    return HarmonicDrivePopulation(
        n_units=6, n_episodes=3, seconds=8.0, seed=21, loop=request.param, outlier=True
    ).simulate()


def settled_segments(episode):
    """Yield (direction, samples) of constant full speed, without the transient, in whole motor revolutions."""
    at_speed = np.flatnonzero(np.abs(episode[:, 4]) > (1 - 1e-7) * MAX_SPEED)
    for segment in np.split(at_speed, np.flatnonzero(np.diff(at_speed) > 1) + 1):
        inside = segment[SETTLE:]
        inside = inside[: len(inside) // TURN * TURN]
        if len(inside) >= 4 * TURN:
            yield int(np.sign(episode[inside[0], 4])), inside


def effect_by_direction(population, unit, condition):
    """Complex amplitude A of e = Im(A exp(j 100 theta)) in each direction, by least squares."""
    found = {1: [], -1: []}
    for key in population.keys(unit, condition):
        x = population.read(key)
        for direction, samples in settled_segments(x):
            theta, error = 100 * x[samples, 0], x[samples, 4] - x[samples, 1]
            basis = np.stack(
                [np.sin(theta), np.cos(theta), np.ones(len(theta)), np.linspace(-1, 1, len(theta))], axis=1
            )
            sine, cosine = np.linalg.lstsq(basis, error, rcond=None)[0][:2]
            found[direction].append(sine + 1j * cosine)
    return {direction: np.mean(values) for direction, values in found.items()}


def wrapped(angle, period):
    return (angle + period / 2) % period - period / 2


def continuous_response(p, gains, loaded):
    """From the disturbance current to the velocity error at full speed, one loop at a time in the s-domain: plant by its
    impedances, sampling and hold by their delays, no aliasing."""
    omega = 100 * MAX_SPEED
    s, z = 1j * omega, np.exp(1j * omega * PERIOD)
    link = p.flange_inertia + loaded * p.load_inertia
    gear = p.damping + p.stiffness / s  # torque per twist velocity
    seen = 1 / (1 / gear + 1 / (link * s))  # what the motor feels of gear and link
    fade = (MAX_SPEED / p.stribeck_velocity) ** 2
    slope = -2 * p.breakaway_torque * fade / (MAX_SPEED * (1 + fade) ** 2)
    mobility = 1 / (p.motor_inertia * s + p.viscous_friction + slope + seen)  # velocity per motor torque
    hold = (1 - np.exp(-s * PERIOD)) / (s * PERIOD)
    estimate = (1 - VELOCITY_POLE) * (1 - 1 / z) / PERIOD / (1 - VELOCITY_POLE / z)
    control = (gains.velocity + gains.integral * PERIOD / (z - 1)) * (gains.position + estimate)
    loop_gain = p.torque_constant * mobility / s * hold / (1 + p.current_lag_s * s) * control
    return estimate / s * p.torque_constant * mobility / (1 + loop_gain)


@pytest.mark.parametrize("condition", ["noload", "load"])
def test_calibration_in_both_directions_recovers_phase_and_lag(drives, condition):
    truth = drives.truth
    response = continuous_response(truth.parameters, truth.gains, condition == "load")
    for row, unit in enumerate(truth.unit_ids):
        effect = effect_by_direction(drives.population, unit, condition)
        forward, reverse = np.angle(effect[1]), np.angle(effect[-1])
        # forward: phi + eta, reverse: phi - eta; half the sum is phi modulo pi; the response itself is known to 0.02 rad
        assert abs(wrapped((forward + reverse) / 2 - truth.phase_rad[row], np.pi)) < 0.01
        assert abs(wrapped((forward - reverse) / 2 - np.angle(response[row]), np.pi)) < 0.03
        for direction in (1, -1):
            size = abs(response[row]) * truth.parameters.ripple[row, 0]
            assert abs(effect[direction]) == pytest.approx(size, rel=0.05)
        # and without the ambiguity: with the true lag each direction gives the phase itself
        assert abs(wrapped(forward - np.angle(response[row]) - truth.phase_rad[row], 2 * np.pi)) < 0.04


def right_hand_side(p, moment, link, u):
    """The equations of motion of one drive, written down from the docstring, on [q, w, s, w_l, i]."""

    def rhs(_, x):
        q, w, s, wl, i = x
        order = np.arange(1, p.ripple.shape[1] + 1)
        ripple = np.sum(p.ripple[0] * np.sin(100 * order * q + p.phase_rad[0]))
        sign = w / np.hypot(w, 0.02)
        friction = (
            sign * (p.coulomb_torque[0] + p.breakaway_torque[0] / (1 + (w / p.stribeck_velocity[0]) ** 2))
            + p.viscous_friction[0] * w
        )
        gear = p.stiffness[0] * s + p.damping[0] * (w - wl)
        dw = (p.torque_constant[0] * (i - ripple) - friction - gear) / p.motor_inertia[0]
        dwl = (gear - moment * np.sin(q - s)) / link
        return [w, dw, w - wl, dwl, (u - i) / p.current_lag_s[0]]

    return rhs


@pytest.mark.parametrize("loaded", [0.0, 1.0])
def test_physics_agree_with_a_general_integrator(loaded):
    p = drives_of(8, 1, 2.0)
    physics = Physics(p, np.array([loaded]), np.array([0.7]))
    link, moment = p.flange_inertia[0] + loaded * p.load_inertia[0], loaded * p.load_moment[0]
    x = np.array([0.7, 0.0, physics.z[0, 0], 0.0, physics.z[3, 0]])
    for k in range(300):
        u = 0.45 * np.sign(np.sin(2 * np.pi * k / 220 + 0.1))
        physics.z[4] = u
        physics.advance()
        rhs = right_hand_side(p, moment, link, u)
        x = solve_ivp(rhs, (0, PERIOD), x, method="DOP853", rtol=1e-9, atol=1e-12).y[:, -1]
        if k % 20 == 19:
            assert physics.q[0] == pytest.approx(x[0], abs=2e-4)
            assert physics.z[1, 0] == pytest.approx(x[1], abs=0.01)
            assert physics.z[3, 0] == pytest.approx(x[4], abs=1e-9)


def test_at_rest_the_load_torque_is_gravity_and_the_current_holds_it(drives):
    truth = drives.truth
    for row, unit in enumerate(truth.unit_ids):
        for key in drives.population.keys(unit, "load"):
            start = drives.population.read(key)[0]
            gravity = truth.parameters.load_moment[row] * np.sin(start[3]) / truth.parameters.torque_constant[row]
            assert truth.load_torque[key][0] == pytest.approx(
                gravity, abs=2e-3
            )  # the twist turns the load by less than 5 mrad
            held = drives.raw.read(key)[:1000, 2].mean()
            physics = Physics(truth.parameters.take([row]), np.ones(1), start[3:4])
            assert held == pytest.approx(truth.load_torque[key][0] + physics.disturbance(start[3:4])[0], abs=2e-3)
