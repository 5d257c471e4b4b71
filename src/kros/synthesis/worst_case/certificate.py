r"""Certified worst-case H2 norm of an observer, however it was found: a correction filter, or filters without feedback.

.. math::
    \frac{1}{2\pi}\int \Big(b_\Delta(\theta) + b_r(\theta)\Big)^2 + \|T_n\|_F^2 \, d\theta + \|\bar e\|^2

``b_Delta`` bounds ``||T_s W_u + T X M||_F`` over the matrix ball (`Ball`): ``T_s``, from the input to the error on the
nominal model, is zero for observers that correct that model. ``b_r`` bounds the additive remainder, a ball around zero;
it adds by the triangle inequality since the same input drives both. The noise is independent, so its square adds; so
does that of the mean error ``bar e``, which a constant in the estimate leaves. Delta is any frequency-wise contraction,
causal or not: the bound is for that set, and an upper bound for causal perturbations.

The mean over the circle is taken on panels that are finer around the poles. Each carries the Gauss-Kronrod rule of 21
points; panels where it disagrees most with that of Gauss are halved.

Symbols
-------
N : (f, a, b) over f frequencies, with Delta and X (f, b, a);  M : (f, a, m);  T : error per unit of w2, shape (f, p, b)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core import ROUNDING, AnyArray, StateSpace, SynthesisError
from ...core.linalg import energy
from ..problem.observer_problem import ObserverProblem
from .ball import dual_bound, uncertain_ball

_ACCURACY = 1e-7  # of the quadrature, relative


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


def circle_mean(density: Callable[[AnyArray], AnyArray], centers: AnyArray, rtol: float) -> tuple[float, float]:
    """Return mean and error over the circle of an even density of angles (k,); `centers` are log poles."""
    from scipy.integrate import cubature

    def power(angles: AnyArray) -> AnyArray:
        values = density(angles[:, 0])
        if not np.isfinite(values).all():
            raise SynthesisError(
                "Integrating the density: it is not finite; is the set well posed and the loop stable?"
            )
        return values

    found = cubature(power, [0.0], [np.pi], rtol=rtol, points=list(_breaks(centers)[:, None]))
    if found.status != "converged":
        text = f"relative error {found.error / found.estimate:.2g} after {found.subdivisions} steps, above {rtol:.2g}"
        raise SynthesisError(f"Integrating the density: {text}; poles are extremely close to the unit circle.")
    return float(found.estimate / np.pi), float(found.error / np.pi)


def _breaks(centers: AnyArray) -> AnyArray:
    """Return the ends of the first panels: two decades each, and the angles of poles."""
    low = max(float(np.abs(centers).min(initial=1.0)) / 100, ROUNDING)
    return np.unique([*np.geomspace(low, 1.0, 1 - int(np.log10(low) / 2)), *np.abs(centers.imag[centers.imag != 0])])
