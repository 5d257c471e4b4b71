"""What the simulation knows and identification must find out.

Steady forward motion at constant speed turns the disturbance `a1 sin(100 theta + phi1)` into a velocity error

    e = target velocity - velocity = |H| a1 sin(100 theta + phi1 + eta),     eta = arg H

and reverse motion into `|H| a1 sin(100 theta + phi1 - eta)`: with the angle running backwards the same delay has the
other sign.

Symbols
-------
H : from disturbance current to velocity error at the gearbox frequency;   Phi, Gu, Gm : map over one substep
zeta : exp(j omega T);   V : from position to velocity estimate;   C : from position to current command
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...data.population import EpisodeKey
from .dynamics import SUBSTEP_S, SUBSTEPS, transition
from .parameters import GEAR_RATIO, SAMPLE_PERIOD_S, VELOCITY_POLE, DriveParameters, Gains, Loop
from .reference import MAX_SPEED

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Truth:
    """True parameters and signals of a simulated population."""

    unit_ids: tuple[str, ...]  # order of the unit axis
    parameters: DriveParameters
    loop: Loop
    gains: Gains
    load_rows: Mapping[EpisodeKey, int]  # row of `load_signals` of each loaded episode
    load_signals: Array  # shape (n_loaded, n_samples), float32, in step with the prepared episodes

    @property
    def phase_rad(self) -> Array:
        """Phase `phi1` of (34), shape (n_units,), rad, in [0, 2 pi)."""
        return self.parameters.phase_rad[:, 0]

    @property
    def ripple(self) -> Array:
        """Amplitude `a1` of (34), shape (n_units,), fraction of full-scale current."""
        return self.parameters.ripple[:, 0]

    @property
    def lag_rad(self) -> Array:
        """Phase `eta` of the disturbance's effect on the velocity error at full speed without load, (n_units,), rad."""
        return np.angle(self.response())

    def response(self, loaded: bool = False) -> Array:
        """Response of the velocity error to the disturbance current at full speed, complex, shape (n_units,), rad/s."""
        return disturbance_response(self.parameters, self.gains, loaded, MAX_SPEED)

    def load_torque(self, key: EpisodeKey) -> Array:
        """Return the torque that the load takes from the flange in an episode, inertia and gravity, (n_samples,)."""
        if key not in self.load_rows:
            raise DataError(f"Load torque of {key}: only the {len(self.load_rows)} loaded episodes have one.")
        return self.load_signals[self.load_rows[key]]

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the long signals, ready for JSON: one entry per unit."""
        lags, loaded = self.lag_rad, np.angle(self.response(loaded=True))
        units = {}
        for row, unit in enumerate(self.unit_ids):
            values = {f.name: getattr(self.parameters, f.name)[row].tolist() for f in fields(self.parameters)}
            units[unit] = {**values, "lag_rad": float(lags[row]), "lag_loaded_rad": float(loaded[row])}
        gains = {f.name: getattr(self.gains, f.name) for f in fields(self.gains)}
        return {"plant": "harmonic-drive", "loop": self.loop.value, "gains": gains, "units": units}


def disturbance_response(p: DriveParameters, gains: Gains, loaded: bool, speed: float = MAX_SPEED) -> Array:
    """Return H, from disturbance current to velocity error, complex, shape (n_units,)."""
    omega = GEAR_RATIO * speed
    zeta = np.exp(1j * omega * SAMPLE_PERIOD_S)
    Phi, Gu, Gm = _substep(p, loaded, speed)
    Phi_T, Gu_T, Gd_T = np.broadcast_to(np.eye(5), Phi.shape), np.zeros_like(Gu), np.zeros(Gm.shape, complex)
    for j in range(SUBSTEPS):
        d = -p.torque_constant[:, None] * np.exp(1j * omega * (j + 0.5) * SUBSTEP_S)
        Phi_T, Gu_T = Phi @ Phi_T, np.einsum("nij,nj->ni", Phi, Gu_T) + Gu
        Gd_T = np.einsum("nij,nj->ni", Phi, Gd_T) + Gm * d
    V = (1 - VELOCITY_POLE) / SAMPLE_PERIOD_S * (1 - 1 / zeta) / (1 - VELOCITY_POLE / zeta)
    C = -(gains.velocity + gains.integral * SAMPLE_PERIOD_S / (zeta - 1)) * (gains.position + V)
    system = zeta * np.eye(5) - Phi_T
    system[:, :, 4] -= C * Gu_T  # u = C q
    states = np.linalg.solve(system, Gd_T[..., None])[..., 0]
    return -V * states[:, 4]


def _substep(p: DriveParameters, loaded: bool, speed: float) -> tuple[Array, Array, Array]:
    """Map over a substep on [s, w, w_l, i, q], with the slope of friction at `speed`."""
    n = len(p)
    M = transition(p, np.full(n, float(loaded)))
    Phi = np.concatenate([M[:, :, :4], np.broadcast_to(np.eye(5)[:, 4:], (n, 5, 1))], axis=2)
    Gu, Gm = M[:, :, 4], M[:, :, 5]
    h = 1e-4
    slope = (p.dry_friction(np.full(n, speed + h)) - p.dry_friction(np.full(n, speed - h))) / (2 * h)
    Phi[:, :, 1] -= Gm * slope[:, None]
    return Phi, Gu, Gm
