r"""H-infinity synthesis: controllers of levels by two Riccati equations (`hinf_central`), and a proof of what is out of reach (`hinf_bound`).

    plant --> coordinates --> first controllers --> proven bound --> levels above it --> central controllers --> closed loop, norm recomputed

What is attained is always a norm that was computed from a closed loop, what is out of reach is proven by signals on which no controller has an
influence. A level for which the equations give no controller proves nothing.

Symbols
-------
gamma : level;  K : controller
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, KrosError, SynthesisError
from ...core.lti import StateSpace, gain
from ...core.norms import h2_norm, hinf_norm
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..result import Injection, Status, Synthesis
from .h2_optimal import h2, stability_margin
from .hinf_bound import proven_bound
from .hinf_central import Obstacle, central
from .hinf_coordinates import Balance, Coordinates, coordinates
from .hinf_pointwise import direct_bound

Array = npt.NDArray[Any]

_MAX_STEPS = 60
_MAX_RAISES = 40
_NEGLIGIBLE = 1e-9
_ROUNDING = 1e-5
_RELAXATIONS = np.geomspace(1e-6, 1.0, 13)


def hinf(
    plant: GeneralizedPlant, *, gamma: float | None = None, tolerance: float = 1e-5, injection: Injection = Injection.NONE
) -> Synthesis:
    r"""Return a controller with the smallest H-infinity norm from w to z, or one below a given level.

    .. math:: \min_K \|T_{zw}\|_\infty = \min_K \sup_\omega \bar\sigma(T_{zw}(e^{j\omega\Delta t}))

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete, or continuous (``dt = 0``); ``D12`` of full column rank, ``D21`` of full row rank, D11 and D22 arbitrary.
    gamma : float, optional
        Ask for this level instead of the optimum. A level well above the optimum gives a calmer controller.
    tolerance : float
        Distance of the norm from the proven bound, as a fraction of it, at which the search ends.
    injection : Injection
        Recorded in the result, for plants of observers.

    Returns
    -------
    Synthesis
        ``hinf_norm`` is recomputed from the closed loop; ``lower_bound`` is the largest level that was proven to be out of reach of every
        controller, by a proof that tolerates rounding, and ``gap_percent`` the distance. The status is OPTIMAL when they agree within the tolerance,
        otherwise CERTIFIED: a better controller may exist.

    Raises
    ------
    ConfigError
        When an option is out of range.
    SynthesisError
        When an assumption fails (each is named, with the remedy), when `gamma` is out of reach, or when no controller survives verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, hinf
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]], [[0]], 1.0)
    >>> found = hinf(plant)
    >>> found.status.value, bool(found.hinf_norm < found.lower_bound * 1.001)
    ('optimal', True)
    """
    if gamma is not None and not (np.isfinite(gamma) and gamma > 0):
        raise ConfigError(f"H-infinity synthesis: gamma should be positive, found {gamma}; leave it out for the optimum.")
    if not 1e-8 <= tolerance < 1:
        raise ConfigError(f"H-infinity synthesis: tolerance should lie in [1e-8, 1), found {tolerance}; 1e-5 is the default.")
    require(plant, "H-infinity synthesis", proper=False)
    start = time.perf_counter()
    if 0 in plant.sizes[2::2]:
        return _without_control(plant, injection, gamma)
    search = _Search.begin(plant, tolerance)
    search = search.at(gamma) if gamma is not None else search.bisect(tolerance)
    elapsed = time.perf_counter() - start
    return _result(search, injection, elapsed, tolerance if gamma is None else None)


@dataclass(frozen=True, eq=False)
class _Search:
    """The best controller so far with its recomputed norm, and the proven bound; later coordinates are for levels where earlier ones fail."""

    plant: GeneralizedPlant
    frames: tuple[Coordinates, ...]
    K: StateSpace | None
    norm: float
    lower: float
    scale: float

    @classmethod
    def begin(cls, plant: GeneralizedPlant, tolerance: float) -> _Search:
        """Bracket the optimum: controllers that are at hand from above, what is proven from below."""
        frames = tuple(coordinates(plant, balance) for balance in Balance)
        search = cls(plant, frames, None, float("inf"), 0.0, 0.0)
        _, _, n_u, _, n_y = plant.sizes
        search = search.consider(gain(np.zeros((n_u, n_y)), plant.dt))
        search = search.consider(_h2_controller(plant))
        for frame in frames:
            if search.K is None and (K := _h2_controller(frame.plant)) is not None:
                search = search.consider(frame.controller(K))
        return search._open().proven(tolerance)

    def proven(self, tolerance: float) -> _Search:
        """Raise the bound, looking from the best norm downwards."""
        return replace(self, lower=max(self.lower, proven_bound(self.plant, self.norm, tolerance)))

    def uncancelled(self) -> float:
        """Size that the closed loop would have if nothing in it cancelled: a norm far below it is rounding."""
        assert self.K is not None
        closed = self.plant.close(self.K)
        direct = float(np.linalg.norm(self.plant.D11))
        if not closed.n_states:
            return direct
        n = closed.n_states
        states = StateSpace(closed.A, closed.B, np.eye(n), np.zeros((n, closed.n_inputs)), closed.dt)
        top = 0.5 / closed.dt if closed.dt > 0 else 10 * max(float(closed.spectral_radius()), 1e-300)
        gains = np.linalg.norm(states.frequency_response(top * np.geomspace(1e-6, 1, 50)), axis=-1)
        return direct + float((gains @ np.linalg.norm(closed.C, axis=0)).max())

    def consider(self, K: StateSpace | None) -> _Search:
        """Keep the controller if its closed loop is stable and better than the best so far."""
        if K is None:
            return self
        try:
            norm = hinf_norm(self.plant.close(K))
        except (KrosError, np.linalg.LinAlgError):
            return self
        return replace(self, K=K, norm=norm) if norm < self.norm else self

    def level(self, gamma: float) -> tuple[_Search, Obstacle | None]:
        """Try one level; what the controller is worth is the norm of its closed loop, whatever the equations promise."""
        search, verdict = self, None
        for frame in self.frames:
            found = central(frame.plant, gamma)
            if isinstance(found, Obstacle):
                verdict = verdict or found
                continue
            try:
                search = search.consider(frame.controller(found))
            except SynthesisError:
                continue
            if search.norm <= gamma * (1 + 1e-6):
                return search, None
        return search, verdict

    def alone(self, gamma: float) -> _Search:
        """Controllers of one level without those that are at hand, which may be better but less calm."""
        return replace(self, K=None, norm=float("inf")).level(gamma)[0]

    def at(self, gamma: float) -> _Search:
        """Controller for a level that was asked for."""
        for margin in (0.0, 1e-7, 1e-6, 1e-5):
            search = self.alone(gamma * (1 - margin))
            if search.norm <= gamma * (1 + 1e-6 * (margin > 0)):
                return search
        best = self.bisect(1e-3)
        if best.norm <= gamma:
            return best
        reached = f"the best that was reached is {best.norm:.6g}, and no controller is below {best.lower:.6g}"
        if best.lower >= gamma:
            _, why = self.level(gamma)
            reason = f" ({why.value})" if why is not None else ""
            raise SynthesisError(f"H-infinity synthesis: the level gamma = {gamma:.6g} is out of reach{reason}; {reached}. Raise gamma.")
        raise SynthesisError(
            f"H-infinity synthesis: the level gamma = {gamma:.6g} was not reached, which does not prove that it cannot be; {reached}. Raise gamma, or scale "
            "states, inputs and outputs to similar size."
        )

    def bisect(self, tolerance: float) -> _Search:
        """Close the gap to the proven bound, or come as low as the equations lead."""
        search = self
        for _ in range(2):
            calm = search.alone(search.lower * (1 + 0.9 * tolerance))
            if calm.norm <= search.lower * (1 + tolerance):
                return calm
            search = search._narrow(tolerance)
            if search._closed(tolerance):
                break
            search = search.proven(tolerance)
        return search

    def _closed(self, tolerance: float) -> bool:
        return self.norm <= max(self.lower * (1 + tolerance), _NEGLIGIBLE * self.scale)

    def _narrow(self, tolerance: float) -> _Search:
        """Bisect between the bound and the best norm. A level that fails only leads the search elsewhere; nothing is concluded from it."""
        search, low = self, self.lower
        floor = _NEGLIGIBLE * search.scale
        for _ in range(_MAX_STEPS):
            high = search.norm
            if high <= max(low * (1 + tolerance / 4), floor) or search._closed(tolerance):
                break
            bottom = max(low, floor)
            middle = float(np.sqrt(bottom * high)) if high > 2 * bottom else (bottom + high) / 2
            search, _ = search.level(middle)
            if search.norm > middle * (1 + 1e-6):
                low = middle
        for relaxation in _RELAXATIONS:
            trial = max(search.lower, floor) * (1 + relaxation)
            if search._closed(tolerance) or trial >= search.norm:
                break
            search, _ = search.level(trial)
        return search

    def _open(self) -> _Search:
        """Find any controller when none is at hand, by raising the level."""
        search, gamma, obstacle = self, 2 * max(direct_bound(self.plant), float(np.linalg.norm(self.plant.D11)), 1e-3), None
        for _ in range(_MAX_RAISES):
            if np.isfinite(search.norm):
                return replace(search, scale=search.uncancelled())
            search, obstacle = search.level(gamma)
            gamma *= 4
        reason = obstacle.value if obstacle is not None else "no closed loop was stable"
        raise SynthesisError(
            f"H-infinity synthesis: no level up to {gamma:.3g} was attained ({reason}); scale states, inputs and outputs to similar size, "
            "or raise noise and penalty."
        )


def _result(search: _Search, injection: Injection, elapsed: float, tolerance: float | None) -> Synthesis:
    K, plant = search.K, search.plant
    if K is None or not np.isfinite(search.norm):
        raise SynthesisError("H-infinity synthesis: no controller survived verification; scale states, inputs and outputs to similar size.")
    norm, lower = search.norm, search.lower
    _, _, n_u, _, n_y = plant.sizes
    if tolerance is not None and K.n_states:
        idle = replace(search, norm=float("inf")).consider(gain(np.zeros((n_u, n_y)), plant.dt))
        if idle.norm <= lower * (1 + tolerance):
            K, norm = gain(np.zeros((n_u, n_y)), plant.dt), idle.norm
    vanishes = norm <= 10 * _NEGLIGIBLE * search.scale
    if not vanishes and lower > norm * (1 + _ROUNDING):
        raise SynthesisError(
            f"H-infinity synthesis: internal error, the bound {lower:.9g} lies above the norm {norm:.9g} that is attained; please report the plant."
        )
    optimal = tolerance is not None and (vanishes or norm <= lower * (1 + tolerance) * (1 + 2e-6))
    closed = plant.close(K)
    return Synthesis(
        method="hinf",
        controller=K,
        status=Status.OPTIMAL if optimal else Status.CERTIFIED,
        injection=injection,
        h2_norm=_h2_norm(closed),
        hinf_norm=norm,
        lower_bound=0.0 if vanishes else min(lower, norm),
        gap_percent=0.0 if vanishes else (100 * (norm / min(lower, norm) - 1) if lower > 0 else None),
        spectral_radius=stability_margin(closed),
        solve_s=elapsed,
        solver="riccati",
    )


def _without_control(plant: GeneralizedPlant, injection: Injection, gamma: float | None) -> Synthesis:
    """Nothing to choose: no control, or no measurement; by then the plant is known to be stable."""
    open_loop = StateSpace(plant.A, plant.B1, plant.C1, plant.D11, plant.dt)
    norm = hinf_norm(open_loop)
    if gamma is not None and norm > gamma:
        raise SynthesisError(f"H-infinity synthesis: without controls or measurements the norm is {norm:.6g}, above gamma = {gamma:.6g}.")
    return Synthesis(
        method="hinf",
        controller=gain(np.zeros((plant.sizes[2], plant.sizes[4])), plant.dt),
        status=Status.OPTIMAL,
        injection=injection,
        h2_norm=_h2_norm(open_loop),
        hinf_norm=norm,
        lower_bound=norm,
        gap_percent=0.0,
        spectral_radius=stability_margin(open_loop),
        solver="riccati",
    )


def _h2_controller(plant: GeneralizedPlant) -> StateSpace | None:
    """H2-optimal controller, for the first upper bound; in continuous time as if D11 were zero."""
    if plant.dt == 0:
        plant = replace(plant, D11=np.zeros_like(plant.D11))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return h2(plant).controller
        except (SynthesisError, RuntimeWarning):
            return None


def _h2_norm(closed: StateSpace) -> float | None:
    """H2 norm; None where poles are so close to the stability boundary that it has no digits."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return h2_norm(closed)
        except RuntimeWarning:
            return None
