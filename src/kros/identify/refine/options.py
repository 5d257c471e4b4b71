"""Settings of the population refinement."""

from __future__ import annotations

from dataclasses import dataclass

from ...core.errors import ConfigError

LARGEST_RESIDUAL = (
    0.5  # peak residual beyond which the set of models that covers a population is too large for a robust observer
)
NEGLIGIBLE_RESIDUAL = 0.1  # peak residual up to which less uncertainty is worth nothing, so that accuracy alone decides
TOLERANCE = 0.1  # the strongest prior whose held-out error exceeds the lowest by no more than this share is chosen
GUARD = 2e-3  # spectral radii above one less this are penalised, so that the search slides along the edge of stability
ALPHA_FACTOR = 4.0  # the start is a pooled EDMD model with this times the smallest alpha that stabilises it
LEAST_GAIN = 1e-3  # relative decrease of the cost below which a horizon is done
SEED = 0  # where the segments start


@dataclass(frozen=True)
class RefineOptions:
    """Settings of `refine_population`.

    Parameters
    ----------
    horizons : tuple of int
        Samples of the free runs, from short to long; the last is the one that the result minimises.
    segments : int
        Stretches of recordings used of every unit, spread over its training episodes.
    strengths : tuple of float
        Strengths of the prior to choose from, tried from the strongest on until weaker ones do not improve the held-out error. At 1 a
        residual of one at all frequencies costs as much as the free-run error of the pooled model (with ``power = 1``; see `metric`).
    balance : float
        A state's error counts in units of ``start**balance * range**(1 - balance)``, with `start` the free-run error of the EDMD
        model and `range` that of the state: 0 weighs states by their range, 1 asks every state for the same improvement.
    starts : tuple of (int, float)
        First horizons and weighings from which the pooled model is sought; the end whose whole free runs are best is taken.
    pooled_segments : int
        Segments of all units together from which the pooled model is sought; it is finished on all.
    margin : float
        Stable means a spectral radius below ``1 - margin``.
    iterations : int
        Most steps of Levenberg-Marquardt per horizon of the pooled model, and of the units at the strength chosen.
    path_iterations : int
        Most steps at each strength before one is chosen; each starts where the stronger prior ended.
    bound : float
        A free run on training episodes may reach this times the range of the states.

    Raises
    ------
    ConfigError
        When a setting is out of its range.

    Examples
    --------
    >>> from kros.identify.refine import RefineOptions
    >>> RefineOptions(horizons=(10, 100), segments=8).horizons
    (10, 100)
    """

    horizons: tuple[int, ...] = (5, 20, 80, 320, 1000)
    segments: int = 24
    strengths: tuple[float, ...] = (1e3, 1e2, 3e1, 1e1, 3.0, 1.0, 0.3, 0.1, 3e-2, 1e-2, 3e-3, 1e-3)
    balance: float = 0.65
    starts: tuple[tuple[int, float], ...] = ((5, 0.8), (320, 0.8))
    pooled_segments: int = 120
    margin: float = 1e-5
    iterations: int = 15
    path_iterations: int = 8
    bound: float = 10.0

    def __post_init__(self) -> None:
        good = {
            "horizons": len(self.horizons) > 0
            and min(self.horizons, default=0) >= 1
            and tuple(sorted(self.horizons)) == self.horizons,
            "segments": self.segments >= 1,
            "strengths": len(self.strengths) > 0 and min(self.strengths, default=0.0) > 0,
            "balance": 0 <= self.balance <= 1,
            "starts": len(self.starts) > 0 and all(0 <= balance <= 1 for _, balance in self.starts),
            "pooled_segments": self.pooled_segments >= 1,
            "margin": 0 <= self.margin < 1,
            "iterations": min(self.iterations, self.path_iterations) >= 1,
            "bound": self.bound >= 1,
        }
        for name, fine in good.items():
            if not fine:
                raise ConfigError(
                    f"Refinement: {name} = {getattr(self, name)} is out of its range; see RefineOptions for what it may be."
                )
