"""Results of the population refinement."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import load_artifact, save_artifact
from ...core.loading import check_shapes, loader
from ..edmd import KoopmanMatrices
from ..ranges import Ranges

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TradeOff:
    """What one strength of the prior brings."""

    strength: float
    held_out_percent: tuple[float, ...]
    score: float
    peak_db: float


@dataclass(frozen=True, eq=False)
class RefinedModels:
    """Refined models of a population.

    Parameters
    ----------
    unit_ids : tuple of str
    units : KoopmanMatrices
        A (unit, n, n) and B (unit, n, m).
    pooled : KoopmanMatrices
        A (n, n) and B (n, m) of the model fitted to all pooled units at once.
    strength : float
        Of the prior, as chosen on held-out training episodes.
    strengths : ndarray, shape (unit,)
        The same for every unit, but stronger where a unit's free runs would have left their bound.
    trade_off : tuple of TradeOff
        One row for every strength that was tried, strongest first, and a first one for the pooled model alone (strength infinite).
    sigma : ndarray, shape (n_states,)
        Errors that count as one.
    converged : ndarray of bool, shape (unit,)
        Whether the last step gained less than `options.LEAST_GAIN`; the others ran out of iterations, and are no less valid.
    information : ndarray, shape (unit, P, P)
        Gauss-Newton matrix of every unit's cost, prior included, for parameters V with ``[A B] = V T^T``.
    whitening : ndarray, shape (p, p)
        T.
    spectral_radius : ndarray, shape (unit,)

    Examples
    --------
    >>> import kros
    >>> from kros.identify import combine, episode_factors
    >>> from kros.identify.refine import RefineOptions, refine_population
    >>> from kros.lifting import Lifting
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=3, seconds=1.0, seed=3).simulate().population
    >>> keys = {unit: motors.keys(unit) for unit in motors.unit_ids}
    >>> factor = combine(episode_factors(motors, keys, Lifting(motors.states)))
    >>> options = RefineOptions(horizons=(20,), segments=4, iterations=3, path_iterations=3)
    >>> refined = refine_population(motors, keys, Lifting(motors.states), {}, factor, options=options)
    >>> refined.pooled.A.shape, refined.strength > 0, refined.converged.shape
    ((3, 3), True, (2,))
    """

    unit_ids: tuple[str, ...]
    units: KoopmanMatrices
    pooled: KoopmanMatrices
    strength: float
    strengths: Array
    trade_off: tuple[TradeOff, ...]
    sigma: Array
    converged: npt.NDArray[np.bool_]
    information: Array
    whitening: Array
    spectral_radius: Array

    def in_channels(self, ranges: Ranges) -> RefinedModels:
        """Return the same result for lifted states and inputs divided by ranges; those of `Ranges.inverse` are the way back."""
        x, u = ranges.outputs, ranges.inputs
        row = np.repeat(x, len(self.whitening))  # of the parameters V, row after row
        return replace(
            self,
            units=ranges.normalise(self.units),
            pooled=ranges.normalise(self.pooled),
            sigma=self.sigma / x[: len(self.sigma)],
            information=self.information * row * row[:, None],
            whitening=self.whitening * np.concatenate([x, u])[:, None],
        )

    def save(self, folder: Path) -> None:
        """Write ``refinement.json`` and ``arrays.npz``; an infinite strength becomes null."""
        content: dict[str, Any] = {
            "unit_ids": self.unit_ids,
            "strength": self.strength,
            "trade_off": [asdict(row) for row in self.trade_off],
            "converged": dict(zip(self.unit_ids, self.converged.tolist(), strict=True)),
        }
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {f"{which}_{m}": getattr(getattr(self, which), m) for which in ("units", "pooled") for m in "AB"}
        save_artifact(folder, "refinement", content, arrays)

    @classmethod
    @loader
    def load(cls, folder: Path) -> RefinedModels:
        """Read what `save` wrote."""
        content, arrays = load_artifact(folder, "refinement")
        axes = {
            "units_A": "unn",
            "units_B": "unm",
            "pooled_A": "nn",
            "pooled_B": "nm",
            "strengths": "u",
            "information": "uPP",
            "spectral_radius": "u",
        }
        check_shapes(arrays, axes, {"u": len(content["unit_ids"])}, Path(folder))
        return cls(
            unit_ids=tuple(content["unit_ids"]),
            units=KoopmanMatrices(arrays["units_A"], arrays["units_B"]),
            pooled=KoopmanMatrices(arrays["pooled_A"], arrays["pooled_B"]),
            strength=content["strength"],
            trade_off=tuple(_row(row) for row in content["trade_off"]),
            converged=np.array([content["converged"][unit] for unit in content["unit_ids"]]),
            **{name: arrays[name] for name in _ARRAYS},
        )


_ARRAYS = ("strengths", "sigma", "information", "whitening", "spectral_radius")


def _row(row: dict[str, Any]) -> TradeOff:
    """A row as it was: what JSON cannot say is null, and stands for a strength, an error or a peak without bound."""
    unbounded = {name: np.inf if row[name] is None else row[name] for name in ("strength", "score", "peak_db")}
    return TradeOff(held_out_percent=tuple(np.inf if v is None else v for v in row["held_out_percent"]), **unbounded)
