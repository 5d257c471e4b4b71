"""Run the drives: sampled control around the physics, many trajectories at once.

Time is the outer loop; every step is vectorised over trajectories. Signals are recorded time-major in small blocks
and turned into one row per trajectory as each block is full.

Symbols
-------
p, v : measured position and velocity;   rp, rv : their targets;   u : current command;   integral : state of the
velocity controller
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .dynamics import COMMAND, CURRENT, MEASURED, RECORDED, Physics, W, load_torque
from .parameters import COUNT_RAD, SAMPLE_PERIOD_S, VELOCITY_POLE, DriveParameters, Gains

Array = npt.NDArray[Any]

BLOCK_SAMPLES = 32
CHUNK_TRAJECTORIES = 800  # keeps the working set of a step in cache
_SIGNALS = (0, 1, MEASURED + 1 + CURRENT)  # recorded rows of position, velocity and current
_COUNTS, _COUNT, _POLE, _LEAST, _MOST = (np.array(c) for c in (1.0 / COUNT_RAD, COUNT_RAD, VELOCITY_POLE, -1.0, 1.0))
_DIFFERENCE = np.array((1.0 - VELOCITY_POLE) / SAMPLE_PERIOD_S)


@dataclass(frozen=True, eq=False)
class SimulatedSignals:
    """What a simulation leaves behind, one row per trajectory."""

    states: (
        Array  # shape (n, 3, n_samples): quantised position, rad, its filtered difference, rad/s, current, noiseless
    )
    velocity: Array  # shape (n, 1, n_samples), rad/s; true velocity of the motor
    load_torque: Array  # shape (n_loaded, n_samples), float32, fraction of full-scale current; taken from the flange


def simulate(
    p: DriveParameters, loaded: Array, reference: Array, targets: tuple[Array, Array], gains: Gains
) -> SimulatedSignals:
    """Simulate all trajectories; `targets` are position (rad) and velocity (rad/s), shape (n_references, n_samples)."""
    n, n_samples = len(p), targets[0].shape[1]
    states, velocity = np.empty((n, len(_SIGNALS), n_samples)), np.empty((n, 1, n_samples))
    out = SimulatedSignals(states, velocity, np.empty((np.count_nonzero(loaded), n_samples), np.float32))
    first_loaded = np.concatenate([[0], np.cumsum(loaded > 0)])
    for start in range(0, n, CHUNK_TRAJECTORIES):
        stop = min(start + CHUNK_TRAJECTORIES, n)
        part = slice(start, stop)
        torque = out.load_torque[first_loaded[start] : first_loaded[stop]]
        chunk = SimulatedSignals(states[part], velocity[part], torque)
        tracked = [(target, reference[part]) for target in targets]
        _simulate_chunk(p.take(part), loaded[part], tracked, gains, chunk)
    return out


def _simulate_chunk(
    p: DriveParameters, loaded: Array, tracked: list[tuple[Array, Array]], gains: Gains, out: SimulatedSignals
) -> None:
    """Simulate some trajectories into `out`; `tracked` holds targets and the one of every trajectory."""
    n, n_samples = len(p), out.states.shape[-1]
    position, rows = tracked[0]
    physics = Physics(p, loaded, position[rows, 0])
    drive = _Controller(physics, gains)
    is_loaded = np.flatnonzero(loaded)
    with_load = p.take(is_loaded)
    recorded = np.empty((BLOCK_SAMPLES, RECORDED, n))
    for first in range(0, n_samples, BLOCK_SAMPLES):
        stop = min(first + BLOCK_SAMPLES, n_samples)
        rp, rv = (np.ascontiguousarray(target[:, first:stop].T)[:, of] for target, of in tracked)
        for k in range(stop - first):
            drive.sample(rp[k], rv[k])
            recorded[k] = physics.rows[:RECORDED]
            physics.advance()
        block = recorded[: stop - first]
        for row, signal in enumerate(_SIGNALS):
            out.states[:, row, first:stop] = block[:, signal].T
        out.velocity[:, 0, first:stop] = block[:, MEASURED + 1 + W].T
        if len(is_loaded):
            torque = load_torque(with_load, block[..., is_loaded].swapaxes(0, 1))
            out.load_torque[:, first:stop] = (torque / with_load.torque_constant).T


class _Controller:
    """Encoder, velocity estimate and cascaded control of a batch; writes measurement and command into the physics."""

    def __init__(self, physics: Physics, gains: Gains) -> None:
        n = len(physics.q)
        self.physics = physics
        self.p, self.v = physics.p_v
        self.p[:] = np.rint(physics.q / COUNT_RAD) * COUNT_RAD
        self._integral = physics.z[COMMAND].copy()
        self._error, self._raw = np.empty(n), np.empty(n)
        self._position, self._velocity = np.array(gains.position), np.array(gains.velocity)
        self._antiwindup = np.array(gains.antiwindup)
        self._integrated = np.array(gains.integral * SAMPLE_PERIOD_S)

    def sample(self, rp: Array, rv: Array) -> None:
        """Measure, and set the command for the coming sampling period."""
        self._measure()
        error, raw, u = self._error, self._raw, self.physics.z[COMMAND]
        np.subtract(rp, self.p, out=error)
        np.multiply(error, self._position, out=error)
        np.add(error, rv, out=error)
        np.subtract(error, self.v, out=error)  # Kp (rp - p) + rv - v
        np.multiply(error, self._velocity, out=raw)
        np.add(raw, self._integral, out=raw)
        np.maximum(raw, _LEAST, out=u)
        np.minimum(u, _MOST, out=u)
        np.multiply(error, self._integrated, out=error)
        np.add(self._integral, error, out=self._integral)
        np.subtract(u, raw, out=raw)
        np.multiply(raw, self._antiwindup, out=raw)
        np.add(self._integral, raw, out=self._integral)

    def _measure(self) -> None:
        """Quantise the position; v becomes a v + (1 - a) (p - last p) / T."""
        new, step = self._error, self._raw
        np.multiply(self.physics.q, _COUNTS, out=new)
        np.rint(new, out=new)
        np.multiply(new, _COUNT, out=new)
        np.subtract(new, self.p, out=step)
        np.multiply(step, _DIFFERENCE, out=step)
        np.multiply(self.v, _POLE, out=self.v)
        np.add(self.v, step, out=self.v)
        self.p[:] = new
