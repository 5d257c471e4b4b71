"""What a perturbation attains: a lower bound of the worst case of one observer, against which certificates are tight."""

from __future__ import annotations

import numpy as np
from numpy.linalg import norm, svd

from kros.core.linalg import adjoint, energy
from kros.synthesis.worst_case.ball import uncertain_ball

FREQUENCIES = 4000


def attained(problem, errors, mean=0.0):
    """Return the norm of `W_p e` for a perturbation that is locally worst at every frequency; without the remainder."""
    nyquist = 0.5 / problem.nominal.dt
    freqs = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES * nyquist
    m, n = problem.nominal.n_inputs, problem.nominal.n_states
    d, r, noise, s = np.split(errors.frequency_response(freqs), [m, m + n, m + n + len(problem.C)], axis=-1)
    T = (d if problem.form.at_input else r) @ problem.W_L.frequency_response(freqs)
    certain = s @ problem.input_weight.frequency_response(freqs) if s.size else 0.0
    ball = uncertain_ball(problem, freqs)
    response = certain + T @ (ball.center + ball.left @ worst(ball, T, certain) @ ball.right)
    return float(np.sqrt(np.mean(energy(response) + energy(noise)) + np.sum(np.square(mean))))


def worst(ball, T, certain, iterations=15):
    """Contraction of an element that is (locally) worst for ``certain + T X M``, shape (f, b, a)."""
    P, Qh = T @ ball.left, adjoint(ball.right)
    left, right = adjoint(svd(P)[2]), svd(ball.right)[0]
    k = min(P.shape[-1], ball.right.shape[-2])
    starts = (
        polar(adjoint(ball.left) @ ball.center @ Qh),
        polar(adjoint(P) @ (certain + T @ ball.center) @ Qh),
        left[..., :k] @ adjoint(right)[..., :k, :],
    )
    best, best_value = starts[0], np.full(T.shape[:-2], -1.0)
    for theta in starts:
        for _ in range(iterations + 1):
            error = certain + T @ (ball.center + ball.left @ theta @ ball.right)
            value = norm(error, axis=(-2, -1))
            best = np.where((value > best_value)[..., None, None], theta, best)
            best_value = np.maximum(value, best_value)
            theta = polar(adjoint(P) @ error @ Qh)
    return best


def polar(matrix):
    """Return the unitary polar factors, shape (f, a, b)."""
    U, _, Vh = svd(matrix, full_matrices=False)
    return U @ Vh
