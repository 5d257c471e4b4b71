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
    factor: Factor  # batch over units, or over units and episodes
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

    def require_factors(self, batch: tuple[int, ...]) -> None:
        """Refuse factors, parameters and marks that are not those of the units."""
        m = len(self.population.inputs) + len(self.lifting.input_functions)
        shape = (*batch, *[2 * self.lifting.n_lifted + m] * 2)
        units = (len(self.keys),)
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
    >>> refinement.pooled.A.shape, refinement.strength > 0, refinement.converged.shape
    ((3, 3), True, (2,))
    """

    pooled: KoopmanMatrices  # A (n, n) and B (n, m) of the model fitted to all pooled units at once
    strength: float  # of the prior, as chosen on held-out training episodes
    sigma: Array  # (n_states,), errors that count as one
    converged: npt.NDArray[np.bool_]  # (unit,); the others ran out of iterations, and are no less valid
    information: Array  # (unit, P, P), Gauss-Newton matrix of every unit's cost for V with ``[A B] = V T^T``
    whitening: Array  # (p, p), T

    def divided_by(self, ranges: Ranges) -> Refinement:
        """Return the same for channels divided by ranges; `Ranges.inverse` is the way back."""
        x, u = ranges.outputs, ranges.inputs
        row = np.repeat(x, len(self.whitening))  # of the parameters V, row after row
        return replace(
            self,
            pooled=ranges.normalise(self.pooled),
            sigma=self.sigma / x[: len(self.sigma)],
            information=self.information * row * row[:, None],
            whitening=self.whitening * np.concatenate([x, u])[:, None],
        )

    def save(self, folder: Path) -> None:
        """Write ``refinement.json`` and ``arrays.npz``."""
        arrays = {name: getattr(self, name) for name in ("sigma", "converged", "information", "whitening")}
        arrays |= {"A": self.pooled.A, "B": self.pooled.B}
        save_artifact(folder, "refinement", {"strength": self.strength}, arrays)

    @classmethod
    @loader
    def load(cls, folder: Path) -> Refinement:
        """Read what `save` wrote."""
        content, arrays = load_artifact(folder, "refinement")
        check_shapes(arrays, {"A": "nn", "B": "nm", "converged": "u", "information": "uPP"}, {}, Path(folder))
        pooled = KoopmanMatrices(arrays.pop("A"), arrays.pop("B"))
        return cls(pooled, content["strength"], **arrays)
