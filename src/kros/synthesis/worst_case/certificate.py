r"""Certified worst-case H2 norm of an observer, however it was found: a correction filter, or filters without feedback.

.. math::
    \frac{1}{2\pi}\int \Big(b_\Delta(\theta) + b_r(\theta)\Big)^2 + \|T_n\|_F^2 \, d\theta + \|\bar e\|^2

``b_Delta`` bounds ``||T_s W_u + T X M||_F`` over the matrix ball (`Ball`): ``T_s``, from the input to the error on the
nominal model, is zero for observers that correct that model. ``b_r`` bounds the additive remainder, a ball around zero;
it adds by the triangle inequality since the same input drives both. The noise is independent, so its square adds; so
does that of the mean error ``bar e``, which a constant in the estimate leaves. Delta is any frequency-wise contraction,
causal or not: the bound is for that set, and an upper bound for causal perturbations.

The mean over the circle is taken on panels, logarithmic in frequency and refined around the poles, with a linear panel
at DC. Each panel carries the Gauss-Legendre rules of 7 and 10 points; panels where these disagree most are halved.

Symbols
-------
N : (f, a, b) over f frequencies, with Delta and X (f, b, a);  M : (f, a, m);  T : error per unit of w2, shape (f, p, b)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core import ITERATED, ROUNDING, AnyArray, StateSpace, SynthesisError
from ...core.linalg import energy
from ..problem.observer_problem import ObserverProblem
from .ball import dual_bound, uncertain_ball

_ACCURACY = 1e-5  # of the quadrature, relative


def density(problem: ObserverProblem, errors: StateSpace, freqs_hz: AnyArray) -> AnyArray:
    """Certified worst-case power density of ``W_p e``, shape (f,), for the error system from (d, r, n[, s])."""
    m, n = problem.nominal.n_inputs, problem.nominal.n_states
    response = errors.frequency_response(freqs_hz)
    d, r, noise, s = np.split(response, [m, m + n, m + n + len(problem.C)], axis=-1)
    T = (d if problem.form.at_input else r) @ problem.W_L.frequency_response(freqs_hz)
    certain = s @ problem.input_weight.frequency_response(freqs_hz) if s.size else 0.0  # T_s W_u
    uncertain = uncertain_ball(problem, freqs_hz).bound(T, certain)
    if problem.remainder is not None:
        left, right = (side.frequency_response(freqs_hz) for side in problem.remainder)
        uncertain = uncertain + dual_bound(np.zeros((r.shape[1], right.shape[2])), r @ left, right)
    return uncertain**2 + energy(noise)


def certify_errors(problem: ObserverProblem, errors: StateSpace, mean: AnyArray | float = 0.0) -> float:
    """Return the certified worst-case H2 norm of ``W_p e``, of an error system from (d, r, n[, s]) and the mean."""
    problem.require_sound()
    if not errors.is_stable():
        radius = float(errors.spectral_radius())
        raise SynthesisError(f"Certificate: the nominal loop has spectral radius {radius:.9g}; no bound is finite.")
    rate = 2 * np.pi * problem.nominal.dt
    systems = [errors, problem.W_L, problem.M, problem.N, problem.remainder_left, problem.remainder_right]
    poles = np.concatenate([s.poles() for s in systems if s is not None]).astype(complex)
    poles = poles[(poles.imag >= 0) & (np.abs(poles) > 1e-3)]
    squared, error = circle_mean(lambda theta: density(problem, errors, theta / rate), np.log(poles), _ACCURACY)
    return float(np.sqrt(squared + error + np.sum(np.square(mean))))


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_ROUGH_NODES, _ROUGH_WEIGHTS = np.polynomial.legendre.leggauss(7)
_ALL = np.concatenate([_NODES, _ROUGH_NODES])


def circle_mean(density: Callable[[AnyArray], AnyArray], centers: AnyArray, rtol: float) -> tuple[float, float]:
    """Return mean and error over the circle of an even density of angles (k,); `centers` are log poles."""
    edges = _edges(centers)
    panels = _panels(density, edges[:-1], edges[1:])
    while (error := panels[3].sum()) > rtol * (total := panels[2].sum()):
        if len(panels.T) > 4000:  # at most
            text = f"relative error {error / total:.2g} after {len(panels.T)} panels, above {rtol:.2g}"
            raise SynthesisError(f"Integrating the density: {text}; poles are extremely close to the unit circle.")
        split = panels[3] > min(0.5 * panels[3].max(), rtol * total / len(panels.T))
        left, right, _, _ = panels[:, split]
        middle = np.where(left > 0, np.sqrt(left * right), right / 4)
        halves = _panels(density, np.concatenate([left, middle]), np.concatenate([middle, right]))
        panels = np.hstack([panels[:, ~split], halves])
    return float(panels[2].sum() / np.pi), float(error / np.pi)


def _edges(centers: AnyArray) -> AnyArray:
    """Panel edges: three a decade, and a row of widths around each pole's angle."""
    angle, width = np.abs(centers.imag), np.abs(centers.real)
    size = np.hypot(angle, width)
    low = min(max(1e-2 * size.min(initial=np.pi), ROUNDING), 1e-3)
    powers = 4.0 ** np.arange(8)
    widths = np.concatenate([-powers, [0.0], powers])
    around = (angle[:, None] + width[:, None] * widths).ravel()
    around = around[(around > low) & (around < np.pi)]
    edges = np.unique(np.concatenate([np.geomspace(low, np.pi, 2 + int(3 * np.log10(np.pi / low))), around]))
    apart = np.diff(np.log(edges), prepend=-np.inf) > ITERATED
    return np.concatenate([[0.0], edges[apart]])


def _panels(density: Callable[[AnyArray], AnyArray], left: AnyArray, right: AnyArray) -> AnyArray:
    """Return ends, integral and its error of every panel; logarithmic inside, linear in the one that touches DC."""
    linear = left <= 0
    log_left = np.log(np.where(linear, 1.0, left))
    log_right = np.where(linear, 0.0, np.log(right))
    middle, half = (log_left + log_right) / 2, (log_right - log_left) / 2
    angles = np.exp(middle[:, None] + half[:, None] * _ALL)
    angles[linear] = right[linear, None] * (1 + _ALL) / 2
    values = density(angles.ravel()).reshape(angles.shape)
    if not np.isfinite(values).all():
        raise SynthesisError("Integrating the density: it is not finite; is the set well posed and the loop stable?")
    weighted = np.where(linear[:, None], values * right[:, None] / 2, values * angles * half[:, None])
    integral = weighted[:, : len(_NODES)] @ _WEIGHTS
    return np.stack([left, right, integral, np.abs(integral - weighted[:, len(_NODES) :] @ _ROUGH_WEIGHTS)])
