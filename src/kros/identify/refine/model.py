"""What the refinement works on, and what it returns beside the models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...core.artifacts import check_shapes, load_artifact, loader, save_artifact
from ...core.errors import DimensionError
from ...data.population import Population
from ...data.prepare import scale_population
from ...lifting import Lifting
from ..edmd import KoopmanMatrices
from ..factors import Factor, Ranges
from .segments import Keys

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Training episodes of every unit with their factors; the units that are `pooled` speak for the population."""

    population: Population
    keys: Keys
    lifting: Lifting
    parameters: Mapping[str, Array]  # (unit,)
    factor: Factor  # batch over units
    pooled: npt.NDArray[np.bool_]  # (unit,)

    @property
    def rows(self) -> npt.NDArray[np.int64]:
        """Rows of the pooled units."""
        return np.flatnonzero(self.pooled)

    def divided_by(self, ranges: Ranges) -> TrainingData:
        """Return the data of channels divided by ranges."""
        sizes = ranges.sizes(self.lifting, self.population.inputs)
        return replace(
            self,
            population=scale_population(self.population, sizes),
            lifting=self.lifting.in_sizes(sizes),
            factor=ranges.factor(self.factor),
        )

    def require_factors(self) -> None:
        """Refuse factors, parameters and marks that are not those of the units."""
        m, units = len(self.population.inputs) + len(self.lifting.input_functions), (len(self.keys),)
        shape = (*units, *[2 * self.lifting.n_lifted + m] * 2)
        wrong = [name for name in self.lifting.parameters if np.shape(self.parameters.get(name, 0.0)) != units]
        if self.factor.R.shape != shape or wrong or self.pooled.shape != units or not self.pooled.any():
            raise DimensionError(
                f"Refinement: needs factors of shape {shape}, found {self.factor.R.shape}, one value of parameters a "
                f"unit (wrong: {wrong}) and a pooled unit, found {int(self.pooled.sum())} of {self.pooled.size}; pass "
                "factors from episode_factors."
            )


@dataclass(frozen=True, eq=False)
class Refinement:
    """What a refinement is known by beside the models of its units.

    Examples
    --------
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=3, seconds=1.0, seed=3).simulate().population
    >>> refinement = kros.identify(motors).refined["linear"]
    >>> refinement.pooled.A.shape, refinement.strength > 0
    ((3, 3), True)
    """

    pooled: KoopmanMatrices  # A (n, n) and B (n, m) of the model fitted to all pooled units at once
    strength: float  # of the prior, as chosen on held-out training episodes

    def save(self, folder: Path) -> None:
        """Write ``refinement.json`` and ``arrays.npz``."""
        save_artifact(folder, "refinement", {"strength": self.strength}, {"A": self.pooled.A, "B": self.pooled.B})

    @classmethod
    @loader
    def load(cls, folder: Path) -> Refinement:
        """Read what `save` wrote."""
        content, arrays = load_artifact(folder, "refinement")
        check_shapes(arrays, {"A": "nn", "B": "nm"}, {}, Path(folder))
        return cls(KoopmanMatrices(arrays["A"], arrays["B"]), content["strength"])
