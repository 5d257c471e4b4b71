"""A second drive simulator, for judging alone: nothing in kros was designed, tuned or chosen on it.

Two masses and a compliant gear with kinematic error and hysteresis, an electric motor with back-EMF behind PI current control, and a cascade
with a tracking filter in place of a filtered difference. Everything is referred to the gearbox output.

    J_m dw/dt  = K_t i - (1 - e'(q)) tau - F(w)              motor
    J_l dw_l/dt = tau - m g l sin(q_l)                       link, and an eccentric mass where there is one
    tau = k s + c s' + h,   s = q - e(q) - q_l               twist of the gear
    e(q) = (1 + a cos(q + chi)) (e_1 sin(N q + phi) + e_2 sin(2 N q + phi_2))
    h'  = sigma s' (1 - h sign(s') / h_max)                  Dahl's hysteresis
    F(w) = (F_c + F_s / (1 + (w / w_s)^2)) tanh(w / w_0) + b w
    L di/dt = v - R i - K_e w,   |v| <= 1

The kinematic error does no work of its own: `tau` acts on the motor through `1 - e'`, so that energy is kept. Positions are advanced with the new
velocities (semi-implicit Euler, every 0.2 ms), current control runs in every such step.

    target position -> (+) -> P -> (+) -> PI, limit -> current -> PI -> voltage
                       -|   target velocity +| -|
                  encoder                   tracking filter of second order

A population has the channels of the project's own drives; `python benchmarks/judging/compliant_drive.py OUT` writes one as Parquet.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kros.data import Channel, EpisodeKey, Population, Role, Unit, write_parquet
from kros.data.prepare import assemble
from kros.plants.batch import SimulatedEpisodes
from kros.plants.harmonic_drive.population import episode_reference

Array = npt.NDArray[np.float64]

PERIOD_S, SUBSTEPS = 1e-3, 5
GEAR_RATIO = 80
COUNT_RAD = 2 * np.pi / (2**14 * GEAR_RATIO)
SPEED = 0.8  # of the reference that the project's own drives follow
REST_SAMPLES = 300  # not recorded
TRACKING_RAD_S, TRACKING_DAMPING = 2 * np.pi * 90.0, 0.8  # of the filter that velocity comes from
POSITION_GAIN, VELOCITY_GAIN, INTEGRAL_GAIN = 18.0, 1.8, 35.0  # 1/s, full scale per rad/s, full scale per rad
CURRENT_BANDWIDTH = 2 * np.pi * 250.0  # rad/s
SUPPLY_W = 300.0  # full voltage times full current
CURRENT_NOISE = 3e-3
SLIP = 0.01  # rad/s, w_0
CONDITIONS = ("noload", "load")
LIFTING = f"sin({GEAR_RATIO}*position + phase)"

# name: (nominal value, relative deviation at spread 1); SI, currents and voltages as fractions of full scale
NOMINAL: dict[str, tuple[float, float]] = {
    "motor_inertia": (0.4, 0.05),
    "link_inertia": (0.08, 0.05),
    "stiffness": (8.0e4, 0.10),
    "damping": (12.0, 0.15),
    "hysteresis_slope": (2.0e4, 0.15),
    "hysteresis_torque": (0.5, 0.15),
    "torque_constant": (40.0, 0.04),
    "resistance": (0.3, 0.06),
    "inductance": (3.0e-4, 0.08),
    "coulomb": (2.5, 0.15),
    "stribeck": (1.2, 0.15),
    "stribeck_velocity": (0.15, 0.15),
    "viscous": (1.2, 0.15),
    "error_1": (4.0e-4, 0.15),
    "error_2": (0.8e-4, 0.15),
    "modulation": (0.25, 0.15),
    "load_inertia": (0.15, 0.05),
    "load_moment": (6.0, 0.05),
}
ANGLES = ("phase", "phase_2", "chi")  # uniform
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("current", Role.STATE, "1"),
    Channel("target_position", Role.INPUT, "rad"),
    Channel("target_velocity", Role.INPUT, "rad/s"),
)
TRUTHS = (Channel("velocity_true", Role.TRUTH, "rad/s", of="velocity"),)


def draw(seed: int, n_units: int, spread: float) -> dict[str, Array]:
    """Draw the drives of a batch, log-normal, each from its own stream; parameters by name, shape (n_units,)."""
    rows = []
    for unit in range(n_units):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(71, unit)))
        row = {
            name: value * np.exp(spread * deviation * rng.standard_normal())
            for name, (value, deviation) in NOMINAL.items()
        }
        rows.append(row | {name: rng.uniform(0.0, 2 * np.pi) for name in ANGLES})
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@dataclass(eq=False)
class Physics:
    """Motor, gear and link of a batch of trajectories, from rest.

    Parameters
    ----------
    p : mapping of str to ndarray, shape (n,)
    loaded : ndarray, shape (n,)
        One where the eccentric mass is mounted, zero elsewhere.
    q : ndarray, shape (n,), rad
        Angle of the motor over the gear ratio.
    step_s : float, s
    """

    p: dict[str, Array]
    loaded: Array
    q: Array
    step_s: float = PERIOD_S / SUBSTEPS
    w: Array = field(init=False)
    ql: Array = field(init=False)
    wl: Array = field(init=False)
    i: Array = field(init=False)
    h: Array = field(init=False)

    def __post_init__(self) -> None:
        p, self.q = self.p, self.q.astype(float).copy()
        self.moment = self.loaded * p["load_moment"]
        self.inertia = p["link_inertia"] + self.loaded * p["load_inertia"]
        self.back_emf = p["torque_constant"] / SUPPLY_W
        self.w, self.wl, self.h = np.zeros((3, len(self.q)))
        error, slope = self.kinematic_error()
        self.ql = self.q - error
        for _ in range(20):  # where gravity and the gear's spring are in balance
            self.ql = self.q - error - self.moment * np.sin(self.ql) / p["stiffness"]
        self.i = (1 - slope) * self.moment * np.sin(self.ql) / p["torque_constant"]

    def kinematic_error(self) -> tuple[Array, Array]:
        """Return the gear's error and its slope over the motor's angle."""
        p, N = self.p, GEAR_RATIO
        one, two = N * self.q + p["phase"], 2 * N * self.q + p["phase_2"]
        wave = p["error_1"] * np.sin(one) + p["error_2"] * np.sin(two)
        rise = N * (p["error_1"] * np.cos(one) + 2 * p["error_2"] * np.cos(two))
        size = 1 + p["modulation"] * np.cos(self.q + p["chi"])
        return size * wave, size * rise - p["modulation"] * np.sin(self.q + p["chi"]) * wave

    def friction(self) -> Array:
        """Friction of the motor at its velocity, N m."""
        p, w = self.p, self.w
        dry = p["coulomb"] + p["stribeck"] / (1 + (w / p["stribeck_velocity"]) ** 2)
        return np.asarray(dry * np.tanh(w / SLIP) + p["viscous"] * w)

    def advance(self, voltage: Array) -> dict[str, Array]:
        """Move on by one step with the voltage held; return the powers that enter and leave, W, for the test of the balance of energy."""
        p, dt = self.p, self.step_s
        error, slope = self.kinematic_error()
        rate = (1 - slope) * self.w - self.wl
        damping, friction = p["damping"] * rate, self.friction()
        torque = p["stiffness"] * (self.q - error - self.ql) + damping + self.h
        drive = p["torque_constant"] * self.i
        w, wl = self.w, self.wl
        self.w = w + dt / p["motor_inertia"] * (drive - (1 - slope) * torque - friction)
        self.wl = wl + dt / self.inertia * (torque - self.moment * np.sin(self.ql))
        mid, mid_l = (w + self.w) / 2, (wl + self.wl) / 2
        bent = (1 - slope) * mid - mid_l
        powers = {"in": drive * mid, "out": friction * mid + (damping + self.h) * bent}
        end = p["hysteresis_torque"] * np.sign(rate)
        self.h = end + (self.h - end) * np.exp(-dt * p["hysteresis_slope"] * np.abs(rate) / p["hysteresis_torque"])
        self.i = self.i + dt / p["inductance"] * (voltage - p["resistance"] * self.i - self.back_emf * mid)
        self.q, self.ql = self.q + dt * self.w, self.ql + dt * self.wl
        return powers

    def energy(self) -> Array:
        """Kinetic energy, the spring's and the mass's, J."""
        twist = self.q - self.kinematic_error()[0] - self.ql
        kinetic = self.p["motor_inertia"] * self.w**2 + self.inertia * self.wl**2
        return np.asarray((kinetic + self.p["stiffness"] * twist**2) / 2 + self.moment * (1 - np.cos(self.ql)))


class Cascade:
    """Encoder, tracking filter and cascaded control; the same software in every unit."""

    def __init__(self, physics: Physics, limit: float) -> None:
        self.physics, self.limit = physics, limit
        self.p = np.rint(physics.q / COUNT_RAD) * COUNT_RAD
        self._tracked, self.v = self.p.copy(), np.zeros_like(self.p)
        self.command = np.clip(physics.i, -limit, limit)
        self._integral = self.command.copy()
        self._kp, self._ki = (CURRENT_BANDWIDTH * NOMINAL[name][0] for name in ("inductance", "resistance"))
        self._voltage = NOMINAL["resistance"][0] * physics.i

    def sample(self, rp: Array, rv: Array) -> None:
        """Measure, and set the command for the coming sampling period."""
        self.p = np.rint(self.physics.q / COUNT_RAD) * COUNT_RAD
        error = self.p - self._tracked
        self.v = self.v + PERIOD_S * TRACKING_RAD_S**2 * error
        self._tracked = self._tracked + PERIOD_S * (self.v + 2 * TRACKING_DAMPING * TRACKING_RAD_S * error)
        wanted = POSITION_GAIN * (rp - self.p) + rv - self.v
        raw = VELOCITY_GAIN * wanted + self._integral
        self.command = np.clip(raw, -self.limit, self.limit)
        held = (raw != self.command) & (np.sign(raw) == np.sign(wanted))  # anti-windup: no further into the limit
        self._integral = self._integral + np.where(held, 0.0, INTEGRAL_GAIN * PERIOD_S * wanted)

    def advance(self) -> None:
        """Let current control and physics run for a sampling period."""
        for _ in range(SUBSTEPS):
            error = self.command - self.physics.i
            raw = self._kp * error + self._voltage
            voltage = np.clip(raw, -1.0, 1.0)
            self._voltage = self._voltage + np.where(raw == voltage, self._ki * self.physics.step_s * error, 0.0)
            self.physics.advance(voltage)


def run(p: dict[str, Array], loaded: Array, targets: Array, limit: float) -> Array:
    """Simulate trajectories; return position, velocity, current and true velocity, shape (4, n, n_samples), for targets (2, n, n_samples)."""
    physics = Physics(p, loaded, targets[0, :, 0])
    drive, out = Cascade(physics, limit), np.empty((targets.shape[2], 4, len(loaded)))
    for k, (rp, rv) in enumerate(np.ascontiguousarray(np.moveaxis(targets, 2, 0))):
        drive.sample(rp, rv)
        out[k] = drive.p, drive.v, physics.i, physics.w
        drive.advance()
    return np.ascontiguousarray(np.moveaxis(out, 0, 2))


def simulate(
    n_units: int = 12,
    n_episodes: int = 6,
    seconds: float = 10.0,
    seed: int = 0,
    spread: float = 1.0,
    limit: float = 1.0,
    conditions: tuple[str, ...] = CONDITIONS,
) -> tuple[Population, dict[str, Any]]:
    """Simulate a population, and return with it what is true about its units; `limit` is that of the current command."""
    units, n_samples = [f"{k + 1:03d}" for k in range(n_units)], round(seconds / PERIOD_S)
    keys = [EpisodeKey(u, c, str(e)) for u in units for c in sorted(conditions) for e in range(n_episodes)]
    rows = np.repeat(np.arange(n_units), len(conditions) * n_episodes)
    parameters = draw(seed, n_units, spread)
    seeds = (np.random.SeedSequence(seed, spawn_key=(0, e)) for e in range(n_episodes))
    streams = map(np.random.default_rng, seeds)
    references = [SPEED * np.stack(episode_reference(rng, n_samples, REST_SAMPLES)) for rng in streams]
    targets = np.stack([references[int(k.episode)] for k in keys], axis=1)
    loaded = np.array([float(k.condition == "load") for k in keys])
    signals = run({name: value[rows] for name, value in parameters.items()}, loaded, targets, limit)[..., REST_SAMPLES:]
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(72,)))
    signals[2] += CURRENT_NOISE * rng.standard_normal(signals[2].shape)
    parts = {key: (signals[:3, i], targets[:, i, REST_SAMPLES:], signals[3:, i]) for i, key in enumerate(keys)}
    metadata = {"plant": "compliant-drive", "gear_ratio": GEAR_RATIO}
    columns = (*CHANNELS, *TRUTHS)
    population = assemble(SimulatedEpisodes(parts), columns, [Unit(u) for u in units], PERIOD_S, metadata)
    return population, {
        "limit": limit,
        "units": {u: {n: float(v[i]) for n, v in parameters.items()} for i, u in enumerate(units)},
    }


def main() -> None:
    """Write a population."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    for name, kind, default in (
        ("units", int, 12),
        ("episodes", int, 6),
        ("seconds", float, 10.0),
        ("seed", int, 0),
        ("spread", float, 1.0),
    ):
        parser.add_argument(f"--{name}", type=kind, default=default)
    parser.add_argument("--limit", type=float, default=1.0)
    o = parser.parse_args()
    write_parquet(simulate(o.units, o.episodes, o.seconds, o.seed, o.spread, o.limit)[0], o.out)


if __name__ == "__main__":
    main()
