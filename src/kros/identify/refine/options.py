"""Settings of the population refinement."""

from __future__ import annotations

from dataclasses import dataclass, field

from ...core.errors import ConfigError
from .gauss_newton import GaussNewton


@dataclass(frozen=True)
class RefineOptions:
    """Settings of `refine_population`: errors of channels divided by their ranges, horizons in samples.

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

    # Data of the search
    horizons: tuple[int, ...] = (320, 1000)  # of the free runs of the pooled model; the last one is minimised
    segments: int = 24  # stretches of recordings of every unit, spread over its training episodes
    pooled_segments: int = 120  # of all units together, from which the pooled model is sought; it is finished on all
    compared: int = 64  # residuals of a state in a segment, at least: neighbouring errors of a long run say the same
    seed: int = 0  # where the segments start

    # Pooled model
    alpha_factor: float = 4.0  # its EDMD start has this times the smallest alpha that stabilises it
    first_balance: float = 0.8  # the balance until the pooled model is first at its minimum
    balance: float = 0.65  # errors count in units of error**balance of EDMD: 0 weighs ranges, 1 the improvement
    least_error: float = 1e-6  # of a state's free run by EDMD: exact data have none to scale by
    row_weight: float = 0.1  # of a lifted function's one-step error, which does not enter free runs

    # Stability
    margin: float = 1e-5  # stable means a spectral radius below one less this
    guard: float = 2e-3  # radii above one less this are penalised: the search slides along the edge of stability
    bound: float = 10.0  # largest value of a free run on training episodes

    # Prior
    prior_level: float = 0.3  # residual up to which the prior is quadratic
    prior_power: int = 2  # beyond the level, which flattens the residual's peak
    strengths: tuple[float, ...] = (1e3, 1e2, 3e1, 1e1, 3.0, 1.0, 0.3, 0.1, 3e-2, 1e-2, 3e-3, 1e-3)  # strongest first
    patience: int = 3  # strengths over which the held-out error must fall by half of the tolerance
    tolerance: float = 0.1  # the strongest prior whose held-out error exceeds the lowest by at most this is chosen
    largest_residual: float = 0.5  # peak beyond which a set of models is too large for a robust observer
    negligible_residual: float = 0.1  # peak up to which accuracy alone decides

    # Search
    search: GaussNewton = field(default_factory=GaussNewton)  # at each horizon, and of the units at the strength chosen
    restarts: int = 4  # searches in which units that have not converged continue
    path_iterations: int = 8  # at each strength before one is chosen; each starts where the stronger prior ended

    def __post_init__(self) -> None:
        """Refuse what is out of its range."""
        usable = {
            "horizons": min(self.horizons, default=0) >= 1 and tuple(sorted(self.horizons)) == self.horizons,
            "segments": self.segments >= 1,
            "pooled_segments": self.pooled_segments >= 1,
            "balance": 0 <= self.balance <= 1,
            "strengths": min(self.strengths, default=0.0) > 0,
            "margin": 0 <= self.margin < 1,
            "bound": self.bound >= 1,
            "search": min(self.search.iterations, self.path_iterations) >= 1,
        }
        for name, fine in usable.items():
            if not fine:
                problem = f"{name} = {getattr(self, name)} is out of its range"
                raise ConfigError(f"Refinement: {problem}; see RefineOptions for what it may be.")
