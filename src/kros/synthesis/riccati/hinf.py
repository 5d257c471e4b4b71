r"""H-infinity synthesis: one search over levels, each with a controller or the condition that fails.

    plant --> frame --> level --> two Riccati equations --> central controller --> closed loop --> upper end
                          ^                 |
                          |                 +--> conditions clearly fail ---------------------------> lower end
                          +----------------------------- next level <---------------------------------+

What is attained is always a norm that was computed from a closed loop. Out of reach is what signals of one frequency
prove (`frequency_bound`), or a level whose conditions fail by more than rounding. A level for which the equations
have no solution proves nothing.

Lower bounds of the H-infinity problem at single frequencies (Parrott's theorem).

Signals ``(s I - A) x = B w, C_y x + D_y w = 0`` reach z whatever the controller does, so that ``||T|| >= |C x + D w| /
|w|``, and alike for the transposed plant. For a regular plant and a level above the bounds of all frequencies, both
Riccati equations of `hinf_level` have stabilising solutions.

Symbols
-------
gamma : level;  K : controller
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ...core import AGREED, EPS, ITERATED, AnyArray, ConfigError, KrosError, StateSpace, SynthesisError, frozen, gain
from ...core.linalg import adjoint
from ...core.norms import first_frequencies, h2_norm, hinf_norm, sharpened
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..result import Status, Synthesis, enclosed
from .hinf_level import Frame


def hinf(plant: GeneralizedPlant, *, tolerance: float = 1e-5) -> Synthesis:
    r"""Return a controller with the smallest H-infinity norm from w to z.

    .. math:: \min_K \|T_{zw}\|_\infty = \min_K \sup_\omega \bar\sigma(T_{zw}(e^{j\omega\Delta t}))

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete, or continuous (``dt = 0``); ``D12`` of full column rank, ``D21`` of full row rank, D11 and D22
        arbitrary.
    tolerance : float
        Distance of the norm from the proven bound, as a fraction of it, at which the search ends. Some percent give a
        calmer controller than the optimum.

    Returns
    -------
    Synthesis
        ``hinf_norm`` is recomputed from the closed loop; ``lower_bound`` is the largest level whose necessary
        conditions fail by more than rounding, and ``gap_percent`` the distance. The status is OPTIMAL when they agree
        within the tolerance, otherwise CERTIFIED: a better controller may exist.

    Raises
    ------
    ConfigError
        When the tolerance is out of range.
    SynthesisError
        When an assumption fails (each is named, with the remedy), or when no controller survives verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, hinf
    >>> zero, D12, D21 = [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], zero, D12, D21, [[0]], 1.0)
    >>> optimum = hinf(plant)
    >>> optimum.status.value, bool(optimum.hinf_norm < optimum.lower_bound * 1.001)
    ('optimal', True)
    """
    if not ITERATED <= tolerance < 1:
        raise ConfigError(f"H-infinity synthesis: tolerance should lie in [1e-9, 1), found {tolerance}.")
    require(plant, "H-infinity synthesis", proper=False)
    idle = _closed(plant, gain(np.zeros((plant.sizes[2], plant.sizes[4])), plant.dt))
    negligible = ITERATED * idle.norm if np.isfinite(idle.norm) else 0.0
    trivial = 0 in plant.sizes[2::2]
    best, lower = (idle, idle.norm) if trivial else _search(Frame.of(plant), idle, tolerance, negligible)
    lower = 0.0 if best.norm <= negligible else lower
    optimal = best.norm <= max(negligible, lower * (1 + tolerance) * (1 + 2 * AGREED))
    if best.K is None:
        remedy = "scale states, inputs and outputs to similar size, or raise noise and penalty"
        raise SynthesisError(f"H-infinity synthesis: no level was attained; {remedy}.")
    lower_bound, gap, notes = enclosed(best.norm, lower)
    closed = plant.close(best.K)
    return Synthesis(
        method="hinf",
        controller=best.K,
        status=Status.OPTIMAL if optimal else Status.CERTIFIED,
        h2_norm=h2_norm(closed),
        hinf_norm=best.norm,
        lower_bound=lower_bound,
        gap_percent=gap,
        spectral_radius=closed.largest_pole(),
        notes=notes,
    )


@frozen
class _Loop:
    """A controller and the recomputed norm of its closed loop; infinite where there is none or it is unstable."""

    K: StateSpace | None
    norm: float = float("inf")


def _closed(plant: GeneralizedPlant, K: StateSpace | None) -> _Loop:
    """Close the loop; what a controller is worth is its norm, whatever the equations promise."""
    if K is None:
        return _Loop(None)
    try:
        closed = plant.close(K)
        limit, size = (1.0, 1.0) if closed.dt > 0 else (0.0, float(np.abs(closed.poles()).max(initial=1.0)))
        return _Loop(K, hinf_norm(closed)) if closed.largest_pole() < limit - ITERATED * size else _Loop(None)
    except (KrosError, np.linalg.LinAlgError):
        return _Loop(None)


def _search(frame: Frame, idle: _Loop, tolerance: float, negligible: float) -> tuple[_Loop, float]:
    """Return the best loop and the largest level that is out of reach, by bisection of the levels between them."""
    best, proven = idle, frequency_bound(frame.scaled)
    lower = low = proven
    level, high = max(2 * proven, 1.0), best.norm
    for _ in range(60):  # bisections, at most
        if best.norm <= max(lower * (1 + tolerance), negligible) or high <= low * (1 + tolerance / 8):
            break
        if np.isfinite(high):
            level = float(np.sqrt(max(low, ITERATED * high) * high))
        K, failed = frame.solve(level)
        trial = _closed(frame.given, K)
        best = min(best, trial, key=lambda loop: loop.norm)
        low, high = (low, min(best.norm, level)) if np.isfinite(trial.norm) else (level, min(high, best.norm))
        lower = level if failed else lower
        level *= 4
    return best, lower if lower <= best.norm else proven  # rounding had its say where levels and norms disagree


_RANK = float(np.sqrt(EPS))  # relative: signals that are smaller prove nothing


def frequency_bound(p: GeneralizedPlant) -> float:
    """Return the largest bound of the frequencies around all poles, searched for around the largest."""
    from scipy.linalg import null_space

    best = 0.0
    for side in (p, p.dual):
        D, free = side.D11, null_space(side.D21)
        best = max(best, float(np.linalg.norm(D @ free, 2)) if D.size and free.size else 0.0)
        if len(p.A) and D.size:
            bounds, points = partial(_bounds, side), _grid(side.A, p.dt)
            best = max(best, sharpened(bounds, points, bounds(points))[1])
    return best


def _bounds(p: GeneralizedPlant, rad: AnyArray) -> AnyArray:
    """Return the bounds at frequencies, rad/s, in discrete time rad per sample."""
    n, m, _, _, q = p.sizes
    # z - 1 keeps the digits at low frequency, where z and A are both close to one.
    point, shifted = (np.expm1(1j * rad), p.A - np.eye(n)) if p.dt > 0 else (1j * rad, p.A)
    system = np.zeros((len(rad), n + q, n + m), complex)
    system[:, :n, :n] = point[:, None, None] * np.eye(n) - shifted
    system[:, :n, n:], system[:, n:, :n], system[:, n:, n:] = -p.B1, p.C2, p.D21
    size = np.linalg.norm(system, axis=2, keepdims=True)
    _, values, Vh = np.linalg.svd(system / np.where(size > 0, size, 1.0))
    # Constraints that only rounding tells from others are none: without an effect of K on z the kernel is larger.
    free = np.ones((len(rad), n + m), bool)
    free[:, : values.shape[1]] = values <= 10 * (n + m) * EPS * values[:, :1]
    kernel = adjoint(Vh) * free[:, None, :]
    # Combinations of the kernel with next to no w prove only as much as rounding leaves.
    _, values, Vh = np.linalg.svd(kernel[:, n:])
    inverse = np.where(values > _RANK, 1 / np.maximum(values, _RANK), 0.0)
    signals = kernel @ adjoint(Vh[:, : values.shape[1]]) * inverse[:, None, :]
    bounds = np.linalg.norm(p.C1 @ signals[:, :n] + p.D11 @ signals[:, n:], 2, axis=(-2, -1))
    return bounds * (1 - 100 * (n + m) * EPS * np.maximum(inverse.max(axis=1), 1.0))


def _grid(A: AnyArray, dt: float) -> AnyArray:
    """Frequencies of a first look, rad/s or rad per sample."""
    poles = np.linalg.eigvals(A)
    if dt == 0:
        return first_frequencies(poles)
    mapped = (poles - 1) / np.where(np.abs(poles + 1) > EPS, poles + 1, EPS)
    return np.append(2 * np.arctan(first_frequencies(mapped)), np.pi)
