"""What the simulation knows and identification must find out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...data.population import EpisodeKey
from .control import Gains, Loop
from .linear import disturbance_response
from .parameters import DriveParameters
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
        """Phase `eta` of the disturbance's effect on the velocity error at full speed without load, shape (n_units,), rad."""
        return np.angle(self.response())

    def response(self, loaded: bool = False) -> Array:
        """Response of the velocity error to the disturbance current at full speed, complex, shape (n_units,), rad/s."""
        return disturbance_response(self.parameters, self.gains, loaded, MAX_SPEED)

    def load_torque(self, key: EpisodeKey) -> Array:
        """Return the torque that the load takes from the flange in an episode, inertia and gravity, shape (n_samples,)."""
        if key not in self.load_rows:
            raise DataError(
                f"Asked for the load torque of {key}; only the {len(self.load_rows)} loaded episodes have one."
            )
        return self.load_signals[self.load_rows[key]]

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the long signals, ready for JSON: one entry per unit."""
        lags, loaded = self.lag_rad, np.angle(self.response(loaded=True))
        units = {}
        for row, unit in enumerate(self.unit_ids):
            own = {f.name: getattr(self.parameters, f.name)[row].tolist() for f in fields(self.parameters)}
            units[unit] = {**own, "lag_rad": float(lags[row]), "lag_loaded_rad": float(loaded[row])}
        gains = {f.name: getattr(self.gains, f.name) for f in fields(self.gains)}
        return {"plant": "harmonic-drive", "loop": self.loop.value, "gains": gains, "units": units}
