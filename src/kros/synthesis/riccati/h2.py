r"""Riccati equations with a check of the residual; the H2 gains built from them.

H2-optimal output feedback by two Riccati equations, discrete (proper controllers, all feedthroughs) and continuous.

Discrete time. With the full-information optimum ``u = F x + F0 w`` the cost of any other control is
:math:`\|T\|_2^2 = \mathrm{const} + \|R_b^{1/2}(u - F x - F_0 w)\|_2^2`; the best causal control is therefore the
conditional expectation of ``F x + F0 w`` given the measurements up to and including now:

    x_hat+ = A x_hat + B2 u + L nu,    u = F x_hat + L0 nu,    nu = y - C2 x_hat

In continuous time ``F0 = 0`` and ``L0 = 0``.

Steady-state Kalman predictor: a constant correction of the state, ``x_hat+ = A x_hat + B u + L (y - C x_hat)``.

Symbols
-------
X : stabilising solution of A' X A - X - (A' X B + S)(R + B' X B)^-1 (B' X A + S') + Q = 0 (discrete), or the continuous
    analogue
F : state feedback, u = F x;  F0 : feedforward of the disturbance, u = F x + F0 w (discrete full information)
X, Y : solutions of the control and filter Riccati equations
R_b = D12' D12 + B2' X B2;   S_y = D21 D21' + C2 Y C2'
F = -R_b^-1 (B2' X A + D12' C1);   F0 = -R_b^-1 (B2' X B1 + D12' D11)
L = (A Y C2' + B1 D21') S_y^-1;   L0 = (F Y C2' + F0 D21') S_y^-1
Q, R : process and measurement noise covariance;  P : covariance of the one-step prediction error;  L : gain, shape (n,
    q)

References
----------
K. Zhou, J. C. Doyle, K. Glover, *Robust and Optimal Control*, sections 14.5 and 21.7.
"""

from __future__ import annotations

import numpy as np
from numpy.linalg import LinAlgError, cholesky, cond, eigh, eigvalsh, solve, svd

from ...core import EPS, ITERATED, ROUNDING, SINGULAR, TINY, AnyArray, ArrayLike, DimensionError, SynthesisError
from ...core.linalg import spectral_radius
from ...core.lti import StateSpace, gain
from ...core.norms import h2_norm, hinf_norm
from ..assumptions import require, require_detectable
from ..generalized_plant import GeneralizedPlant
from ..result import Injection, Status, Synthesis


def solve_riccati(A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray, dt: float, method: str) -> AnyArray:
    """Return the stabilising solution X of the algebraic Riccati equation."""
    from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov, solve_discrete_are

    if not A.size:
        return np.zeros((0, 0))
    if dt == 0 and not B.shape[1]:
        return solve_continuous_lyapunov(A.T, -Q)
    if dt > 0:
        X = _doubling(A, B, Q, R, S)
        if X is not None and _residual(A, B, Q, R, S, X) < ITERATED:
            return X
    try:
        X = (solve_discrete_are if dt > 0 else solve_continuous_are)(A, B, Q, R, s=S)
    except (LinAlgError, ValueError) as error:
        problem = f"the Riccati equation of {len(A)} states has no stabilising solution that can be computed ({error})"
        raise SynthesisError(f"{method}: {problem}; check stabilisability, detectability and scaling.") from error
    X = (X + X.T) / 2
    if dt > 0 and (residual := _residual(A, B, Q, R, S, X)) > 1e-5:
        problem = f"the Riccati solution has residual {residual:.2g}"
        raise SynthesisError(f"{method}: {problem}; scale states, inputs and outputs to similar size.")
    return X


def discrete_gain(A: AnyArray, B: AnyArray, R: AnyArray, S: AnyArray, X: AnyArray) -> AnyArray:
    """Optimal discrete feedback ``F = -(R + B' X B)^-1 (B' X A + S')``."""
    return -solve(R + B.T @ X @ B, B.T @ X @ A + S.T)


def _residual(A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray, X: AnyArray) -> float:
    """Relative residual in the closed-loop (Joseph) form, which does not cancel; infinite for an unstable loop."""
    F = discrete_gain(A, B, R, S, X)
    closed = A + B @ F
    if spectral_radius(closed) >= 1:
        return float("inf")
    cost = Q + S @ F + F.T @ S.T + F.T @ R @ F
    # A plant that can be inverted costs nothing, X = 0: what is left is measured against the terms that cancel.
    size = max(float(np.linalg.norm(X)), float(np.linalg.norm(Q)), TINY)
    return float(np.linalg.norm(closed.T @ X @ closed + cost - X)) / size


def _doubling(A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray) -> AnyArray | None:
    """Structure-preserving doubling (Chu, Fan, Lin and Wang, 2004): quadratic convergence, sums of semidefinites."""
    try:
        RiS, RiB = solve(R, S.T), solve(R, B.T)
        Ak, G, H = A - B @ RiS, B @ RiB, Q - S @ RiS
        eye = np.eye(len(A))
        for _ in range(60):
            W = solve(eye + G @ H, np.hstack([Ak, G]))
            WA, WG = W[:, : len(A)], W[:, len(A) :]
            step = Ak.T @ H @ WA
            G = G + Ak @ WG @ Ak.T
            H = H + (step + step.T) / 2
            G = (G + G.T) / 2
            Ak = Ak @ WA
            if not np.isfinite(H).all():
                break
            if np.linalg.norm(step) <= EPS * np.linalg.norm(H):
                return H
    except LinAlgError:
        pass
    return None


def riccati_pair(p: GeneralizedPlant, method: str) -> tuple[AnyArray, AnyArray]:
    """Return the solutions of the control and filter Riccati equations of a plant's H2 problem."""
    X, Y = (
        solve_riccati(s.A, s.B2, s.C1.T @ s.C1, s.D12.T @ s.D12, s.C1.T @ s.D12, s.dt, f"{method}, {side}")
        for side, s in (("control", p), ("filter", p.dual))
    )
    return X, Y


def absorb_feedthrough(K: StateSpace, D22: AnyArray) -> StateSpace:
    """Turn a controller for ``y - D22 u`` into one for ``y``."""
    if not np.any(D22):
        return K
    loop = np.eye(K.n_outputs) + K.D @ D22
    if cond(loop) > SINGULAR:
        raise SynthesisError("Algebraic loop: I + D^c D22 is singular; add a delay to the plant, or change D22.")
    C, D = solve(loop, K.C), solve(loop, K.D)
    return StateSpace(K.A - K.B @ D22 @ C, K.B - K.B @ D22 @ D, C, D, K.dt)


def balancing(R: AnyArray, S: AnyArray, negligible: float = 0.0) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Balance the Gramians ``R R'`` and ``S S'``: left, right, ``left @ right = I``, and the Hankel singular values.

    The balanced state is ``left x``. Values below a share of the largest are `negligible`.
    """
    U, values, Vh = svd(S.T @ R, full_matrices=False)
    k = int(np.sum(values > negligible * values.max(initial=0.0)))
    root = np.sqrt(values[:k])
    return (U[:, :k] / root).T @ S.T, R @ Vh[:k].T / root, values[:k]


_AGREEMENT = 1e-4  # of the norm with its promise


def h2(plant: GeneralizedPlant) -> Synthesis:
    """Return the controller with the smallest H2 norm from w to z.

    Parameters
    ----------
    plant : GeneralizedPlant
        ``D12`` of full column rank, ``D21`` of full row rank, and ``D11 = 0`` in continuous time.

    Returns
    -------
    Synthesis
        ``h2_norm`` is recomputed from the closed loop; ``lower_bound`` is the value that the Riccati solutions promise.

    Raises
    ------
    SynthesisError
        When an assumption fails (each is named, with the remedy), a Riccati equation has no solution, or the result
        does not survive verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, h2
    >>> zero, D12, D21 = [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], zero, D12, D21, [[0]], 1.0)
    >>> h2(plant).status.value
    'optimal'
    """
    require(plant, "H2 synthesis")
    K, promised, rounding = _optimum(plant)
    K = absorb_feedthrough(K, plant.D22)
    closed = plant.close(K)
    norm = h2_norm(closed)
    if not np.isfinite(norm) or abs(norm - promised) > _AGREEMENT * promised + rounding:
        raise SynthesisError(
            f"H2 synthesis: the closed loop has norm {norm:.9g} where the Riccati solutions promise {promised:.9g}; "
            "scale states, inputs and outputs to similar size."
        )
    lower = min(promised, norm)
    return Synthesis(
        method="h2",
        controller=K,
        status=Status.OPTIMAL,
        h2_norm=norm,
        hinf_norm=hinf_norm(closed),
        lower_bound=lower,
        gap_percent=100 * (norm / lower - 1) if lower > rounding else 0.0,
        spectral_radius=closed.largest_pole(),
    )


def _optimum(p: GeneralizedPlant) -> tuple[StateSpace, float, float]:
    """Return the optimal controller for D22 = 0, its norm by the Riccati solutions, and the rounding of that norm."""
    X, Y = riccati_pair(p, "H2 synthesis")
    sampled = float(p.dt > 0)  # in continuous time nothing is known of the same moment
    ahead = p.A if sampled else np.eye(len(p.A))
    R, S = p.D12.T @ p.D12 + sampled * (p.B2.T @ X @ p.B2), p.D21 @ p.D21.T + sampled * (p.C2 @ Y @ p.C2.T)
    F = -solve(R, p.B2.T @ X @ ahead + p.D12.T @ p.C1)
    F0 = -sampled * solve(R, p.B2.T @ X @ p.B1 + p.D12.T @ p.D11)
    L = solve(S, p.C2 @ Y @ ahead.T + p.D21 @ p.B1.T).T
    L0 = sampled * solve(S, (F @ Y @ p.C2.T + F0 @ p.D21.T).T).T
    C = F - L0 @ p.C2
    K = StateSpace(p.A - L @ p.C2 + p.B2 @ C, L + p.B2 @ L0, C, L0, p.dt)
    terms = [np.trace(p.D11.T @ p.D11 + p.B1.T @ X @ p.B1), -np.trace(F0.T @ R @ F0)]  # of full information
    terms += [np.trace(R @ (F @ Y @ F.T + F0 @ F0.T)), -np.trace(R @ L0 @ S @ L0.T)]
    rounding = ROUNDING * sum(abs(term) for term in terms)  # the terms may cancel
    return K, float(np.sqrt(max(sum(terms), 0.0))), float(np.sqrt(rounding))


def kalman(A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike, dt: float = 1.0) -> Synthesis:
    """Return the steady-state Kalman predictor as a constant correction of the state.

    Parameters
    ----------
    A : array_like, shape (n, n)
        Discrete dynamics.
    C : array_like, shape (q, n)
        Measured combinations of the state.
    Q : array_like, shape (n, n)
        Process noise covariance, positive semidefinite.
    R : array_like, shape (q, q)
        Measurement noise covariance, positive definite.
    dt : float, s
        Sampling period of the result.

    Returns
    -------
    Synthesis
        ``controller.D`` is the gain L, shape (n, q); ``h2_norm`` is the root of the trace of the prediction error's
        covariance.

    Raises
    ------
    DimensionError
        When sizes do not fit.
    SynthesisError
        When R is not positive definite, Q not positive semidefinite, or the pair (A, C) undetectable (the mode is
        named).

    Examples
    --------
    >>> from kros.synthesis import kalman
    >>> synthesis = kalman([[1.0]], [[1.0]], [[1.0]], [[2.0]])
    >>> float(synthesis.controller.D[0, 0])  # P = 2, L = 2 / (2 + 2)
    0.5
    """
    A, C, Q, R = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (A, C, Q, R))
    n, q = A.shape[0], C.shape[0]
    if A.shape != (n, n) or C.shape != (q, n) or Q.shape != (n, n) or R.shape != (q, q):
        shapes = f"{A.shape}, {C.shape}, {Q.shape}, {R.shape}"
        raise DimensionError(f"Kalman predictor: needs A (n, n), C (q, n), Q (n, n), R (q, q), found {shapes}.")
    if eigvalsh((R + R.T) / 2).min() <= 0:
        raise SynthesisError("Kalman predictor: R is not positive definite; every measurement needs some noise.")
    values, vectors = eigh((Q + Q.T) / 2)
    if values.min() < -ROUNDING * max(values.max(), TINY):
        problem = f"Q has the eigenvalue {values.min():.3g}"
        raise SynthesisError(f"Kalman predictor: {problem}; it must be positive semidefinite.")
    require_detectable(A, C, dt, "Kalman predictor")
    L, _ = predictor(A, C, Q, R, np.zeros((n, q)), "Kalman predictor")
    closed = A - L @ C
    noise = np.hstack([vectors * np.sqrt(np.maximum(values, 0)), -L @ cholesky(R)])
    norm = h2_norm(StateSpace(closed, noise, np.eye(n), np.zeros((n, n + q)), dt))
    return Synthesis(
        method="kalman",
        controller=gain(L, dt),
        status=Status.OPTIMAL,
        injection=Injection.STATE,
        h2_norm=norm,
        spectral_radius=float(spectral_radius(closed)),
    )


def predictor(
    A: AnyArray, C: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray, method: str
) -> tuple[AnyArray, AnyArray]:
    """Gain and covariance of the one-step predictor for noise covariances Q, R and cross covariance S (n, q)."""
    P = solve_riccati(A.T, C.T, Q, R, S, 1.0, method)
    return -discrete_gain(A.T, C.T, R, S, P).T, P


def predictor_bound(A: AnyArray, B: AnyArray, C: AnyArray, D: AnyArray, Z: AnyArray) -> float:
    """Return the least ``E |Z (x - x_hat)|^2`` for ``x+ = A x + B nu``, ``y = C x + D nu``; zero if unknown."""
    try:
        _, P = predictor(A, C, B @ B.T, D @ D.T, B @ D.T, "Lower bound")
    except SynthesisError:
        return 0.0
    return max(float(np.trace(Z @ P @ Z.T)), 0.0)
