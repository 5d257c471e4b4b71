"""Run the drives: sampled control around the physics, many trajectories at once.

Time is the outer loop; every step is vectorised over trajectories. Signals are kept time-major in small blocks and turned
over into one row per trajectory as each block is full.

Symbols
-------
p, v : measured position and velocity;   rp, rv : their targets;   u : current command;   integral : state of the velocity controller
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .control import COUNT_RAD, SAMPLE_PERIOD_S, VELOCITY_POLE, Gains
from .dynamics import COMMAND, CURRENT, Physics, W
from .parameters import DriveParameters

Array = npt.NDArray[Any]

BLOCK_SAMPLES = 256
CHUNK_TRAJECTORIES = 800  # keeps the working set of a step in cache
SIGNALS = 4  # position, velocity, current, true velocity; the load torque after them


@dataclass(frozen=True, eq=False)
class Signals:
    """What a simulation leaves behind, one row per trajectory.

    Parameters
    ----------
    states : ndarray, shape (n, 3, n_samples), rad, rad/s and fraction of full scale
        Position as the encoder quantises it, velocity as filtered difference of it, current without measurement noise.
    velocity : ndarray, shape (n, 1, n_samples), rad/s
        True velocity of the motor.
    load_torque : ndarray of float32, shape (n_loaded, n_samples), fraction of full-scale current
        Torque that the load takes from the flange, for the loaded trajectories, in their order.
    """

    states: Array
    velocity: Array
    load_torque: Array


def simulate(p: DriveParameters, loaded: Array, reference: Array, targets: tuple[Array, Array], gains: Gains) -> Signals:
    """Simulate all trajectories.

    Parameters
    ----------
    p : DriveParameters
        One row per trajectory.
    loaded : ndarray, shape (n,)
        One where the asymmetric load is mounted, zero elsewhere.
    reference : ndarray of int, shape (n,)
        Row of `targets` that the trajectory follows.
    targets : two ndarrays, shape (n_references, n_samples), rad and rad/s
        Target position and velocity; at rest at the first sample.
    gains : Gains
    """
    n, n_samples = len(p), targets[0].shape[1]
    n_loaded = int(np.count_nonzero(loaded))
    rows = np.cumsum(loaded > 0) - 1
    out = Signals(np.empty((n, SIGNALS - 1, n_samples)), np.empty((n, 1, n_samples)), np.empty((n_loaded, n_samples), np.float32))
    for start in range(0, n, CHUNK_TRAJECTORIES):
        part = slice(start, start + CHUNK_TRAJECTORIES)
        _simulate_chunk(p.take(part), loaded[part], reference[part], targets, gains, out, part, rows[part])
    return out


def _simulate_chunk(
    p: DriveParameters, loaded: Array, reference: Array, targets: tuple[Array, Array], gains: Gains, out: Signals, part: slice, rows: Array
) -> None:
    n, n_samples = len(p), targets[0].shape[1]
    physics = Physics(p, loaded, targets[0][reference, 0])
    drive = _Controller(physics, gains)
    total_inertia = p.flange_inertia + loaded * p.load_inertia
    load_inertia = loaded * p.load_inertia
    is_loaded = loaded > 0
    any_loaded = bool(is_loaded.any())
    block = np.empty((SIGNALS + 1, BLOCK_SAMPLES, n))
    for first in range(0, n_samples, BLOCK_SAMPLES):
        stop = min(first + BLOCK_SAMPLES, n_samples)
        rp, rv = (np.ascontiguousarray(t[:, first:stop].T)[:, reference] for t in targets)
        for k in range(stop - first):
            drive.sample(rp[k], rv[k])
            block[0, k], block[1, k], block[2, k], block[3, k] = drive.p, drive.v, physics.z[CURRENT], physics.z[W]
            if any_loaded:
                block[SIGNALS, k] = physics.load_torque(load_inertia, total_inertia)
            physics.advance()
        length = stop - first
        out.states[part, :, first:stop] = block[:3, :length].transpose(2, 0, 1)
        out.velocity[part, 0, first:stop] = block[3, :length].T
        if any_loaded:
            out.load_torque[rows[is_loaded], first:stop] = (block[SIGNALS, :length] / p.torque_constant).T[is_loaded]


class _Controller:
    """Encoder, velocity estimate and cascaded control of a batch; writes the command into the physics."""

    def __init__(self, physics: Physics, gains: Gains) -> None:
        n = len(physics.q)
        self.physics, self.gains = physics, gains
        self.p = np.rint(physics.q / COUNT_RAD) * COUNT_RAD
        self.v = np.zeros(n)
        self._integral = physics.z[COMMAND].copy()
        self._error, self._raw = np.empty(n), np.empty(n)

    def sample(self, rp: Array, rv: Array) -> None:
        """Measure, and set the command for the coming sampling period."""
        self._measure()
        g, error, raw, u = self.gains, self._error, self._raw, self.physics.z[COMMAND]
        np.subtract(rp, self.p, out=error)
        np.multiply(error, g.position, out=error)
        np.add(error, rv, out=error)
        np.subtract(error, self.v, out=error)  # Kp (rp - p) + rv - v
        np.multiply(error, g.velocity, out=raw)
        np.add(raw, self._integral, out=raw)
        np.clip(raw, -1.0, 1.0, out=u)
        np.multiply(error, g.integral * SAMPLE_PERIOD_S, out=error)
        np.add(self._integral, error, out=self._integral)
        np.subtract(u, raw, out=raw)
        np.multiply(raw, g.antiwindup, out=raw)
        np.add(self._integral, raw, out=self._integral)

    def _measure(self) -> None:
        """Quantise the position; v becomes a v + (1 - a) (p - last p) / T."""
        new, step = self._error, self._raw
        np.multiply(self.physics.q, 1.0 / COUNT_RAD, out=new)
        np.rint(new, out=new)
        np.multiply(new, COUNT_RAD, out=new)
        np.subtract(new, self.p, out=step)
        np.multiply(step, (1.0 - VELOCITY_POLE) / SAMPLE_PERIOD_S, out=step)
        np.multiply(self.v, VELOCITY_POLE, out=self.v)
        np.add(self.v, step, out=self.v)
        np.copyto(self.p, new)
