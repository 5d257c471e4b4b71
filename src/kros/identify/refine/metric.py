"""How far apart two models are, as the uncertainty of the population will count it: the metric of the prior.

With E the residual of the inverse input multiplicative form, to first order ``dE = G^+ dG`` in scaled inputs and outputs. From
``G = (zI - A)^-1 B = Phi B`` follows ``dG = Phi dW Z`` with ``Z = [G; I]``, so that ``dE = (G^+ Phi) dW Z`` and

    mean over frequency of ||dE||_F^2 = sum_ijkl dW_ij dW_kl Re[(a_i^* a_k)(z_j^* z_l)],      a = G^+ Phi,  z = Z^T
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_DECADES_BELOW_NYQUIST = 6
_POINTS = 100


def response_metric(A: Array, B: Array, T: Array, output_scale: Array, input_scale: Array) -> Array:
    """Return the matrix of the quadratic form above, for changes of V with ``W = V T^T``.

    Parameters
    ----------
    A : ndarray, shape (n, n)
        Stable.
    B : ndarray, shape (n, m)
    T : ndarray, shape (n + m, n + m)
    output_scale, input_scale : ndarray, shape (n,) and (m,)

    Returns
    -------
    ndarray, shape (n (n + m), n (n + m))
    """
    n, m = B.shape
    z = np.exp(1j * np.pi * np.logspace(-_DECADES_BELOW_NYQUIST, 0, _POINTS))
    Phi = np.linalg.solve(z[:, None, None] * np.eye(n) - A, np.eye(n) + 0j * z[:, None, None])
    G = Phi @ B * input_scale
    a = np.linalg.pinv(G / output_scale[:, None]) @ (Phi / output_scale[:, None])  # (frequency, m, n)
    Z = T.T @ np.concatenate([G, np.broadcast_to(np.diag(input_scale), (len(z), m, m))], axis=1)  # (frequency, n + m, m)
    by_row = np.swapaxes(a.conj(), -1, -2) @ a
    by_column = Z.conj() @ np.swapaxes(Z, -1, -2)
    form = np.einsum("fik,fjl->ijkl", by_row, by_column).real / len(z)
    return np.asarray(form.reshape(n * (n + m), -1))
