"""Settings of the population refinement."""

from __future__ import annotations

from dataclasses import dataclass, field

from ...core.errors import ConfigError
from .gauss_newton import GaussNewton


@dataclass(frozen=True)
class RefineOptions:
    """Settings of `refine_population`; all errors are of channels divided by their ranges.

    Parameters
    ----------
    horizons : tuple of int
        Samples of the free runs, from short to long; the last is the one that the result minimises.
    segments : int
        Stretches of recordings used of every unit, spread over its training episodes.
    pooled_segments : int
        Segments of all units together from which the pooled model is sought; it is finished on all.
    compared : int
        Residuals of a state that a segment contributes, at least: at long horizons neighbouring errors say the same.
    seed : int
        Where the segments start.
    starts : tuple of (int, float)
        First horizons and weighings from which the pooled model is sought, since the cost has several minima; the end whose whole free
        runs are best is taken.
    balance : float
        A state's error counts in units of ``error**balance``, with the free-run error of the EDMD model: 0 weighs states by their
        range, 1 asks every state for the same improvement.
    least_error : float
        Least free-run error, relative to a state's range: exact data have none to scale by.
    trial_iterations : int
        Steps within the edge of stability before the ends of the starts are compared.
    shortenings : int
        Steps in which the rows of lifted functions are shortened when a model is unstable.
    penalties : int
        Decades over which the weight of the edge of stability then grows.
    alpha_factor : float
        The pooled EDMD model has this times the smallest alpha that stabilises it.
    strengths : tuple of float
        Strengths of the prior to choose from, tried from the strongest on until weaker ones do not improve the held-out error. At 1 a
        residual of one at all frequencies costs as much as the free-run error of the pooled model (with ``power = 1``; see `metric`).
    patience : int
        Strengths over which the held-out error must improve by half of `tolerance`.
    tolerance : float
        The strongest prior whose held-out error exceeds the lowest by no more than this share is chosen.
    largest_residual : float
        Peak residual beyond which the set of models that covers a population is too large for a robust observer.
    negligible_residual : float
        Peak residual up to which less uncertainty is worth nothing, so that accuracy alone decides.
    prior_level, prior_power : float
        Residual up to which the prior is quadratic, and the power beyond it, which flattens the residual's peak.
    row_weight : float
        Of a lifted function's one-step error against a state's free-run error, which it does not enter.
    margin : float
        Stable means a spectral radius below ``1 - margin``.
    guard : float
        Spectral radii above one less this are penalised, so that the search slides along the edge of stability.
    bound : float
        A free run on training episodes may reach this times the range of the states.
    search : GaussNewton
        Of the pooled model at each horizon, and of the units at the strength chosen.
    restarts : int
        Searches in which units that have not converged continue.
    path_iterations : int
        Most steps at each strength before one is chosen; each starts where the stronger prior ended.

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
    pooled_segments: int = 120
    compared: int = 64
    seed: int = 0
    starts: tuple[tuple[int, float], ...] = ((5, 0.8), (320, 0.8))
    balance: float = 0.65
    least_error: float = 1e-6
    trial_iterations: int = 4
    shortenings: int = 20
    penalties: int = 8
    alpha_factor: float = 4.0
    strengths: tuple[float, ...] = (1e3, 1e2, 3e1, 1e1, 3.0, 1.0, 0.3, 0.1, 3e-2, 1e-2, 3e-3, 1e-3)
    patience: int = 3
    tolerance: float = 0.1
    largest_residual: float = 0.5
    negligible_residual: float = 0.1
    prior_level: float = 0.3
    prior_power: int = 2
    row_weight: float = 0.1
    margin: float = 1e-5
    guard: float = 2e-3
    bound: float = 10.0
    search: GaussNewton = field(default_factory=GaussNewton)
    restarts: int = 4
    path_iterations: int = 8

    def __post_init__(self) -> None:
        """Refuse what is out of its range."""
        usable = {
            "horizons": min(self.horizons, default=0) >= 1 and tuple(sorted(self.horizons)) == self.horizons,
            "segments": self.segments >= 1,
            "pooled_segments": self.pooled_segments >= 1,
            "starts": len(self.starts) > 0 and all(0 <= balance <= 1 for _, balance in self.starts),
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
