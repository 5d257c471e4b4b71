r"""Rational scalings for the D-K iteration: fitted to the best ones frequency by frequency, then descended on what counts.

A fit that is uniform in decibels wastes its order where scalings matter little. So the fit is only the start, and the scalings themselves minimise
``max_f sigma_max(D_L T D_R^-1) / mu(T)``, the loss against the best scalings at every frequency (by p-norms over frequency, p growing). With u, v the
singular vectors, ``d log sigma / d log d_i = |u_i|^2 - |v_i|^2`` over the signals of block i.

Every scaling is a product of second-order sections in the bilinear variable s, with ``nu = tan(theta / 2)``,

    d(s) = e^g  prod_k (s^2 + 2 zeta_k w_k s + w_k^2) / (s^2 + 2 zeta'_k w'_k s + w'_k^2),

whose parameters are logarithms (of w and of zeta beyond a least damping): any value is stable and minimum phase.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, block_diagonal, gain
from ...uncertainty.fits.magnitude import fit_magnitude, invert
from ..reduction.descent import bfgs
from .blocks import Structure
from .scalings import scalings

Array = npt.NDArray[Any]

_POWERS = (10.0, 40.0, 160.0)
_STEPS = 60
_COUPLED = 1e-6
_LEAST = 0.2  # damping of every section: sharper ones would fit the grid and not what lies between its points


@dataclass(frozen=True, eq=False)
class RationalScalings:
    """Scalings of every entry of a structure but the last, which is one.

    Parameters
    ----------
    structure : Structure
    log_gain : ndarray, shape (entries,)
    sections : ndarray, shape (entries, k, 4)
        ``log w, log (zeta - 0.2)`` of the numerator, then of the denominator.
    dt : float, s
    """

    structure: Structure
    log_gain: Array
    sections: Array
    dt: float

    def systems(self) -> tuple[StateSpace, StateSpace]:
        """Return the filters of z and of w."""
        own = [_system(g, sections, self.dt) for g, sections in zip(self.log_gain, self.sections, strict=True)] + [gain([[1.0]], self.dt)]
        seen, driven = membership(self.structure)
        return block_diagonal([own[i] for i in seen]), block_diagonal([own[i] for i in driven])


def log_magnitude(sections: Array, freqs_hz: Array, dt: float) -> tuple[Array, Array]:
    """Return ``log |d|`` without gain, shape (entries, f), and its derivatives with respect to the sections, shape (entries, k, 4, f)."""
    square = np.tan(np.minimum(np.pi * freqs_hz * dt, np.pi / 2 - 1e-9)) ** 2
    w2, extra = np.exp(2 * sections[..., 0::2, None]), np.exp(sections[..., 1::2, None])
    zeta = _LEAST + extra
    q = (w2 - square) ** 2 + 4 * zeta**2 * w2 * square
    by_zeta = 4 * zeta * extra * w2 * square / q
    by_w = (2 * w2 * (w2 - square) + 4 * zeta**2 * w2 * square) / q
    sign = np.array([1.0, -1.0])[:, None]
    derivative = np.stack([by_w * sign, by_zeta * sign], axis=-2).reshape(*sections.shape, len(freqs_hz))
    return 0.5 * np.sum(np.log(q) * sign, axis=(1, 2)), derivative


def membership(structure: Structure) -> tuple[Array, Array]:
    """Return which entry scales each signal of z and of w; a full block has one entry, a repeated scalar as many as signals."""
    seen: list[int] = []
    driven: list[int] = []
    for block in structure.blocks:
        first = max(seen, default=-1) + 1
        seen += range(first, first + block.rows) if block.repeated else [first] * block.columns
        driven += range(first, first + block.rows) if block.repeated else [first] * block.rows
    return np.array(seen), np.array(driven)


def rational_scalings(closed: StateSpace, grid_hz: Array, freqs_hz: Array, structure: Structure, sections: int) -> RationalScalings:
    """Return scalings with a small peak of the scaled closed loop.

    Parameters
    ----------
    closed : StateSpace
        From w to z.
    grid_hz : ndarray, Hz
        Where the start is fitted.
    freqs_hz : ndarray, Hz
        Where the peak is looked for.
    structure : Structure
    sections : int
        Second-order sections of every scaling.
    """
    seen, driven = membership(structure)
    dt, start_T = closed.dt, closed.frequency_response(grid_hz)
    off = np.linalg.norm(np.where(seen[:, None] == driven, 0.0, start_T), axis=(-2, -1))
    coupled = off > _COUPLED * np.linalg.norm(start_T, axis=(-2, -1))  # elsewhere any scaling is best
    if coupled.sum() > 4 * sections + 4:
        grid_hz, start_T = grid_hz[coupled], start_T[coupled]
    freqs_hz = np.concatenate([[0.0], freqs_hz, [0.5 / dt]])
    T = closed.frequency_response(freqs_hz)
    best = scalings(T, structure, diagonal=True).upper
    T = T / np.maximum(best, 1e-3 * best.max())[:, None, None]
    power = np.real(np.einsum("fii->fi", scalings(start_T, structure, diagonal=True).X_L))
    entries = int(seen.max())
    first = [int(np.flatnonzero(seen == i)[0]) for i in range(entries)]
    magnitude = np.sqrt(power[:, first] / power[:, -1:])
    fits = [_start(grid_hz, column, dt, sections) for column in magnitude.T]
    start = RationalScalings(structure, np.array([f[0] for f in fits]), np.array([f[1] for f in fits]).reshape(entries, sections, 4), dt)
    if not entries:
        return start
    x = np.concatenate([start.log_gain, start.sections.ravel()])

    def unpack(x: Array) -> RationalScalings:
        return RationalScalings(structure, x[:entries], x[entries:].reshape(start.sections.shape), dt)

    for p in _POWERS:
        x = bfgs(lambda x, p=p: _peak(unpack(x), T, freqs_hz, p), x, _STEPS, 1e-6)  # type: ignore[misc]
    return unpack(x)


def _peak(scaling: RationalScalings, T: Array, freqs_hz: Array, p: float) -> tuple[float, Array]:
    """Logarithm of the p-norm over frequency of the largest singular value, and its gradient."""
    seen, driven = membership(scaling.structure)
    log_d, derivative = log_magnitude(scaling.sections, freqs_hz, scaling.dt)
    log_d = log_d + scaling.log_gain[:, None]
    d = np.exp(np.vstack([log_d, np.zeros(len(freqs_hz))])).T
    if not np.isfinite(d).all() or not d.all():
        return float("inf"), np.zeros(log_d.shape[0] + derivative[..., 0].size)
    U, s, Vh = np.linalg.svd(d[:, seen, None] * T / d[:, None, driven])
    log_s = np.log(np.maximum(s[:, 0], 1e-300))
    share = np.exp(p * (log_s - log_s.max()))
    value = float(log_s.max() + np.log(share.mean()) / p)
    share = share / share.sum()
    entries = range(log_d.shape[0])
    towards = np.array(
        [np.sum(np.abs(U[:, seen == i, 0]) ** 2, axis=1) - np.sum(np.abs(Vh[:, 0, driven == i]) ** 2, axis=1) for i in entries]
    )
    towards = towards * share
    return value, np.concatenate([towards.sum(axis=1), np.einsum("if,iklf->ikl", towards, derivative).ravel()])


def _start(freqs_hz: Array, magnitude: Array, dt: float, sections: int) -> tuple[float, Array]:
    """Logarithm of the gain and the sections of a fit."""
    found = np.zeros((sections, 2, 2))
    found[:, :, 0] = np.log(np.tan(np.pi * np.geomspace(freqs_hz[0], freqs_hz[-1], sections + 2)[1:-1, None] * dt))
    if sections:
        system = fit_magnitude(freqs_hz, magnitude, dt, order=2 * sections).system
        for side, roots in enumerate((invert(system).poles(), system.poles())):
            pairs = _pairs((roots - 1) / (roots + 1))
            found[: len(pairs), side] = pairs
    parameters = found.reshape(sections, 4)
    offset = np.log(magnitude) - log_magnitude(parameters[None], freqs_hz, dt)[0][0]
    return float((offset.max() + offset.min()) / 2), parameters


def _pairs(roots: Array) -> Array:
    """``log w, log (zeta - 0.2)`` of the second-order factors that contain the roots (left half plane); a single one is doubled."""
    upper = roots[roots.imag > 1e-12 * np.abs(roots)]
    real = np.sort(-roots[np.abs(roots.imag) <= 1e-12 * np.abs(roots)].real)
    real = np.maximum(np.append(real, real[-1]) if len(real) % 2 else real, 1e-12)
    w = np.concatenate([np.abs(upper), np.sqrt(real[0::2] * real[1::2])])
    damping = np.concatenate([-upper.real, (real[0::2] + real[1::2]) / 2])
    return np.stack([np.log(w), np.log(np.maximum(damping / w - _LEAST, 0.1))], axis=1)


def _system(log_gain: float, sections: Array, dt: float) -> StateSpace:
    """Series of the sections, discrete by the bilinear map."""
    system = gain([[np.exp(log_gain)]], dt)
    for log_w, log_zeta, log_wp, log_zetap in sections:
        a, b = _polynomial(log_wp, log_zetap), _polynomial(log_w, log_zeta)
        d = b[0] / a[0]
        C = np.array([[b[1] / a[0] - d * a[1] / a[0], b[2] / a[0] - d * a[2] / a[0]]])
        system = StateSpace([[-a[1] / a[0], -a[2] / a[0]], [1.0, 0.0]], [[1.0], [0.0]], C, [[d]], dt) @ system  # type: ignore[arg-type]
    return system


def _polynomial(log_w: float, log_zeta: float) -> tuple[float, float, float]:
    """Coefficients in z of ``(z - 1)^2 + 2 zeta w (z - 1)(z + 1) + w^2 (z + 1)^2``."""
    w, middle = np.exp(log_w), 2 * (_LEAST + np.exp(log_zeta)) * np.exp(log_w)
    return 1 + middle + w**2, 2 * (w**2 - 1), 1 - middle + w**2
