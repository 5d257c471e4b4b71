r"""H-infinity synthesis: bisection on the level gamma, each level decided by two Riccati equations (`hinf_central`).

    plant --> coordinates --> bracket --> bisection --> central controller --> closed loop, norm recomputed

The upper end of the bracket is always a norm that was computed from a closed loop, the lower end a level that was shown to be out of reach: by
Parrott's bound at some frequency, or by a condition of the Riccati equations.

Symbols
-------
gamma : level;  K : controller;  P11, P12, P21 : frequency responses of the plant
"""

from __future__ import annotations

import contextlib
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
from .hinf_central import Obstacle, central, direct_bound
from .hinf_coordinates import Balance, Coordinates, coordinates

Array = npt.NDArray[Any]

_MAX_STEPS = 100
_MAX_RAISES = 40
_NEGLIGIBLE = 1e-9
_SURELY = 1e3  # a level so far above an attained one is attained by any account
_AGREEMENT = 1e-6
_RELAXATIONS = (0.0, *np.geomspace(1e-6, 0.1, 16))


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
        Relative width of the bracket around the optimum at which the search ends.
    injection : Injection
        Recorded in the result, for plants of observers.

    Returns
    -------
    Synthesis
        ``hinf_norm`` is recomputed from the closed loop; ``lower_bound`` is the largest level that was shown to be out of reach of every
        controller, and ``gap_percent`` the distance. The status is OPTIMAL when they agree within the tolerance, otherwise CERTIFIED.

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
    search = _Search.begin(plant)
    search = search.at(gamma) if gamma is not None else search.bisect(tolerance)
    elapsed = time.perf_counter() - start
    return _result(search, injection, elapsed, tolerance if gamma is None else None)


@dataclass(frozen=True, eq=False)
class _Search:
    """The best controller so far with its recomputed norm, and the bracket; later frames are for levels where earlier ones fail."""

    plant: GeneralizedPlant
    frames: tuple[Coordinates, ...]
    K: StateSpace | None
    norm: float
    lower: float
    scale: float
    known: float = 0.0  # the part of `lower` that no frame has a say in

    @classmethod
    def begin(cls, plant: GeneralizedPlant) -> _Search:
        """Bracket the optimum: Parrott's bound from below, controllers that are at hand from above."""
        frames = tuple(coordinates(plant, balance) for balance in Balance)
        mapped = frames[-1].plant
        bound = max(_frequency_bound(mapped), direct_bound(mapped)) * (1 - 1e-9)
        search = cls(plant, frames, None, float("inf"), bound, 0.0, bound)
        _, _, n_u, _, n_y = plant.sizes
        search = search.consider(gain(np.zeros((n_u, n_y)), plant.dt))
        search = search.consider(_h2_controller(plant))
        for frame in frames:
            if search.K is None and (K := _h2_controller(frame.plant)) is not None:
                search = search.consider(frame.controller(K))
        return search._open()._seeing()

    def _seeing(self) -> _Search:
        """Keep the frames that do not deny a level far above one that is attained: with poles next to the boundary, rounding may blind a frame."""
        seeing = tuple(f for f in self.frames if not _denied(f, _SURELY * self.norm))
        return replace(self, frames=seeing) if seeing else self

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

    def level(self, gamma: float, verify: bool = True) -> tuple[_Search, Obstacle | None]:
        """Decide one level; what the controller is worth is the norm of its closed loop, whatever the equations promise."""
        search, verdict = self, [Obstacle.NUMERICAL]
        for frame in self.frames:
            found = central(frame.plant, gamma)
            if isinstance(found, Obstacle):
                if found is not Obstacle.NUMERICAL and gamma < self.norm:
                    return replace(search, lower=max(search.lower, gamma)), found
                continue
            verdict = []
            if not verify:
                break
            try:
                search = search.consider(frame.controller(found))
            except SynthesisError:
                continue
            if search.norm <= gamma * (1 + 1e-6):
                break
        return search, verdict[0] if verdict else None

    def at(self, gamma: float) -> _Search:
        """Controller for a level that was asked for."""
        blank = replace(self, K=None, norm=float("inf"))
        search, obstacle = blank.level(gamma)
        for margin in (1e-7, 1e-6, 1e-5):
            if obstacle is not None or search.norm <= gamma:
                break
            closer, _ = search.level(gamma * (1 - margin))
            search = closer if closer.norm < search.norm else search
        if search.norm <= gamma * (1 + 1e-6):
            return replace(search, lower=self.lower)
        best = self.bisect(1e-3)
        reached = f"the best that was reached is {best.norm:.6g}, and no controller is below {best.lower:.6g}"
        why = obstacle.value if obstacle is not None else f"the closed loop has norm {search.norm:.6g}"
        if best.norm <= gamma:
            return best
        raise SynthesisError(f"H-infinity synthesis: the level gamma = {gamma:.6g} is out of reach ({why}); {reached}. Raise gamma.")

    def bisect(self, tolerance: float) -> _Search:
        """Narrow the bracket to the tolerance."""
        search, low, high = self, self.lower, self.norm
        floor = _NEGLIGIBLE * search.scale
        for _ in range(_MAX_STEPS):
            if high <= max(low * (1 + tolerance / 4), floor):
                break
            bottom = max(low, floor)
            middle = float(np.sqrt(bottom * high)) if high > 2 * bottom else (bottom + high) / 2
            search, obstacle = search.level(middle, verify=False)
            low, high = (low, middle) if obstacle is None else (middle, high)
        return search._contested(tolerance) or search._settle(high, tolerance)

    def _contested(self, tolerance: float) -> _Search | None:
        """Search again without the frames that deny a level which another one attains; None where all agree."""
        found = self
        for frame in self.frames:
            K = central(frame.plant, self.lower)
            with contextlib.suppress(SynthesisError):
                found = found.consider(None if isinstance(K, Obstacle) else frame.controller(K))
        if found.norm >= self.lower * (1 - _AGREEMENT):
            return None
        right = tuple(f for f in self.frames if not _denied(f, self.lower))
        return replace(found, frames=right, lower=self.known).bisect(tolerance) if len(right) < len(self.frames) else None

    def _open(self) -> _Search:
        """Find any controller when none is at hand, by raising the level."""
        search, gamma = self, 2 * max(self.lower, float(np.linalg.norm(self.plant.D11)), 1e-3)
        for _ in range(_MAX_RAISES):
            if np.isfinite(search.norm):
                return replace(search, scale=search.uncancelled())
            search, obstacle = search.level(gamma)
            gamma *= 4
        reason = obstacle.value if obstacle is not None else "no closed loop was stable"
        raise SynthesisError(
            f"H-infinity synthesis: no level up to {gamma:.3g} is attained ({reason}); scale states, inputs and outputs to similar size, "
            "or raise noise and penalty."
        )

    def _settle(self, gamma: float, tolerance: float) -> _Search:
        """Take the calmest controller within the tolerance, or relax the level where none survives verification so close to the optimum."""
        allowed = self.lower * (1 + tolerance)
        calm, _ = replace(self, K=None, norm=float("inf")).level(self.lower * (1 + 0.9 * tolerance))
        if calm.norm <= allowed:
            return calm
        search = self
        for relaxation in _RELAXATIONS:
            if search.norm <= max(allowed, _NEGLIGIBLE * search.scale, gamma * (1 + relaxation)):
                break
            search, _ = search.level(gamma * (1 + relaxation))
        return search


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


def _denied(frame: Coordinates, gamma: float) -> bool:
    found = central(frame.plant, gamma)
    return isinstance(found, Obstacle) and found is not Obstacle.NUMERICAL


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


def _frequency_bound(p: GeneralizedPlant) -> float:
    """Largest Parrott bound over a grid of frequencies; it holds for every controller."""
    n, n_w, n_u, n_z, n_y = p.sizes
    sizes = np.abs(np.linalg.eigvals(p.A)) if n else np.ones(1)
    typical = float(np.median(sizes)) or 1.0
    # The odd factor keeps the grid off poles on the boundary.
    freqs_hz = 1.0137 * typical * np.geomspace(1e-4, 1e4, 200) / (2 * np.pi)
    try:
        P = p.open_loop().frequency_response(freqs_hz)
        P11, P12, P21 = P[:, :n_z, :n_w], P[:, :n_z, n_w:], P[:, n_z:, :n_w]
        outside_z = np.linalg.svd(P12)[0][:, :, n_u:].conj().transpose(0, 2, 1) @ P11
        outside_w = P11 @ np.linalg.svd(P21)[2][:, n_y:].conj().transpose(0, 2, 1)
    except np.linalg.LinAlgError:
        return 0.0
    return max(_largest(outside_z), _largest(outside_w))


def _largest(matrices: Array) -> float:
    return float(np.linalg.norm(matrices, 2, axis=(-2, -1)).max()) if matrices.size else 0.0
