r"""The uncertain set of signals: residuals of recorded machines, covered over units in frequency.

Along any recording the model ``x+ = A theta(x) + B u + r`` leaves the residual r, which holds all that it does not
know: the unit's own parameters, loads, unmodelled effects, the lifting's error. In front of it stands the error of the
first estimate, as a sample: it excites the error of an observer as a residual does. With ``Phi_b`` the energies of r in
bands, exact (`bands`), the set is

.. math:: \mathcal{S} = \{ r : \Phi_b(r) \preceq \bar\Phi_b \text{ in every band } b \}, \qquad
          \bar\Phi_b \succeq \Phi_b(r_i) \text{ for every recorded unit } i .

Nothing is in a loop and no form has to fit: tall plants cost nothing. It is valid for motion like that recorded.
Another model has other residuals, so every model has a set of its own; what is compared is the error that observers are
certified to stay below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from .bands import Array, BandEnergies, band_edges


@dataclass(frozen=True, eq=False)
class SignalSet:
    """Residuals of a population along its recordings."""

    unit_ids: tuple[str, ...]
    energies: BandEnergies  # of every unit, shape (unit, b, n, n): the mean over its episodes, per sample

    def __post_init__(self) -> None:
        if self.energies.energy.ndim != 4 or len(self.energies.energy) != len(self.unit_ids):
            raise DimensionError(
                f"Signal set: {len(self.unit_ids)} units need as many energies, found {self.energies.energy.shape}."
            )

    @classmethod
    def of(
        cls,
        residual: Array,
        lengths: npt.ArrayLike,
        units: Sequence[str],
        start: Array | None = None,
        edges: npt.ArrayLike | None = None,
    ) -> SignalSet:
        """Return the set of one-step residuals (n_samples, batch, n) of episodes."""
        lengths = np.asarray(lengths, dtype=int)
        first = np.zeros((1, *residual.shape[1:])) if start is None else np.asarray(start, dtype=float)[None]
        signal, samples = np.concatenate([first, residual]), lengths + 1  # as many estimates, the first among them
        found = BandEnergies.of(signal, samples, band_edges(int(samples.max())) if edges is None else edges)
        return cls(tuple(dict.fromkeys(units)), found.of_units(units))

    @cached_property
    def cover(self) -> BandEnergies:
        """Energies that no unit exceeds."""
        return self.energies.cover()

    def spectrum(self, n_points: int, weights: npt.ArrayLike | None = None) -> Array:
        """Return a density (n_points, n, n) from zero to Nyquist, even over every band."""
        edges = self.energies.edges
        energy = (
            self.cover.energy
            if weights is None
            else np.tensordot(np.asarray(weights, dtype=float), self.energies.energy, 1)
        )
        total = np.concatenate([np.zeros((1, *energy.shape[1:])), np.cumsum(energy, axis=0)])
        step = np.pi / (n_points - 1)
        cells = np.clip((np.arange(n_points + 1) - 0.5) * step, 0.0, np.pi)
        at = np.clip(np.searchsorted(edges, cells, side="right") - 1, 0, len(edges) - 2)
        share = ((cells - edges[at]) / np.diff(edges)[at])[:, None, None]
        return np.asarray(
            np.diff(total[at] * (1 - share) + total[at + 1] * share, axis=0) * (np.pi / np.diff(cells))[:, None, None]
        )
