"""What the simulation knows and identification must find out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy.typing as npt

from ...core.errors import DataError
from ...data.population import EpisodeKey
from .parameters import DriveParameters, Gains, Loop

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

    def load_torque(self, key: EpisodeKey) -> Array:
        """Return the torque that the load takes from the flange in an episode, inertia and gravity, (n_samples,)."""
        if key not in self.load_rows:
            raise DataError(f"Load torque of {key}: only the {len(self.load_rows)} loaded episodes have one.")
        return self.load_signals[self.load_rows[key]]

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the long signals, ready for JSON: one entry per unit."""
        names = [f.name for f in fields(self.parameters)]
        rows = enumerate(self.unit_ids)
        units = {unit: {name: getattr(self.parameters, name)[row].tolist() for name in names} for row, unit in rows}
        gains = {f.name: getattr(self.gains, f.name) for f in fields(self.gains)}
        return {"plant": "harmonic-drive", "loop": self.loop.value, "gains": gains, "units": units}
