r"""Shaping filters: stable models of low order whose output has a given spectrum.

The signal omega passes a basis of delays and first-order lags, ``z+ = A_z z + B_z omega``, with covariance

.. math:: G = \frac{1}{2\pi} \int Z S Z^H \, d\theta, \qquad Z = (e^{j\theta} I - A_z)^{-1} B_z

and is predicted from it by least squares, ``omega = Theta z + Sigma^(1/2) w``: with delays alone this is the vector
autoregression of Yule and Walker, and lags lengthen its memory without many states. The model is ``z+ = (A_z + B_z
Theta) z + B_z Sigma^(1/2) w``. Because the prediction error is orthogonal to z, ``G = (A_z + B_z Theta) G (...)' + B_z
Sigma B_z'`` holds exactly, on a grid of frequencies too, so the filter is *always stable* and reproduces G. Everything
is linear in the spectrum until the least squares: spectra of units may be weighted.

References
----------
C. I. Byrnes, T. T. Georgiou and A. Lindquist, "A new approach to spectral estimation: a tunable high-resolution
spectral estimator", IEEE Transactions on Signal Processing 48 (2000) 3189-3205.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ...core.arrays import AnyArray, frozen
from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.rounding import ITERATED, ROUNDING

_FLOOR = ROUNDING  # white noise of every channel, relative to the largest, which keeps the Gramian regular


@frozen
class Basis:
    """Delays and first-order lags of every channel."""

    delays: int = 8
    # Of the lags, inside the unit circle, each one once: disturbances that last up to 300 samples
    poles: tuple[float, ...] = (0.9, 0.97, 0.99, 0.997)

    @cached_property
    def scalar(self) -> tuple[AnyArray, AnyArray]:
        """Dynamics and input of the basis of one channel."""
        from scipy.linalg import block_diag

        shift = np.eye(self.delays, k=-1)
        poles = np.array(self.poles)
        b = np.concatenate([np.eye(self.delays, 1)[:, 0], np.sqrt(1 - poles**2)])
        return block_diag(shift, np.diag(poles))[-self.size :, -self.size :], b

    @property
    def size(self) -> int:
        """States a channel."""
        return self.delays + len(self.poles)

    def response(self, z: AnyArray) -> AnyArray:
        """Return Z of one channel at points of the unit circle, shape (f, size)."""
        lags = np.sqrt(1 - np.array(self.poles) ** 2) / (z[:, None] - np.array(self.poles))
        return np.hstack([z[:, None] ** -np.arange(1, self.delays + 1), lags])

    def system(self, n: int) -> tuple[AnyArray, AnyArray]:
        """Return A_z and B_z for n channels, the channels of one delay or lag side by side."""
        (A, b), size = self.scalar, n * self.size
        return np.kron(A, np.eye(n)).reshape(size, size), np.kron(b[:, None], np.eye(n)).reshape(size, n)


def circle_weights(f: int) -> AnyArray:
    """Return weights of the mean over the unit circle, for f equal steps from zero to Nyquist; they sum to one."""
    weight = np.full(f, 1.0 / (f - 1))
    weight[[0, -1]] /= 2
    return weight


def shaping_filter(spectrum: AnyArray, basis: Basis, dt: float) -> StateSpace:
    """Fit a shaping filter to a spectrum."""
    f, n = spectrum.shape[:2]
    weight = circle_weights(f)
    R = np.tensordot(weight, spectrum, 1).real
    largest = float(np.max(np.diag(R), initial=0.0))
    if not (np.isfinite(R).all() and largest > 0):
        raise SynthesisError("Shaping filter: the residual is zero or not finite; correct nothing (open loop).")
    R = R + _FLOOR * largest * np.eye(n)
    response = basis.response(np.exp(1j * np.linspace(0, np.pi, f)))
    k = basis.size
    blocks = np.einsum("f,fa,fb,fij->aibj", weight, response, response.conj(), spectrum, optimize=True).real
    floor = np.einsum("f,fa,fb->ab", weight, response, response.conj()).real
    G = blocks.reshape(k * n, k * n) + _FLOOR * largest * np.kron(floor, np.eye(n)).reshape(k * n, k * n)
    cross = np.einsum("f,fb,fij->ibj", weight, response.conj(), spectrum, optimize=True).real.reshape(n, k * n)
    cross = cross + _FLOOR * largest * np.kron(weight @ response.conj().real, np.eye(n)).reshape(n, k * n)
    Theta = np.linalg.solve(G, cross.T).T if k else cross
    innovation = R - Theta @ cross.T
    values, vectors = np.linalg.eigh((innovation + innovation.T) / 2)
    if values.max() <= ITERATED * largest:
        error = f"{np.sqrt(max(values.max(), 0) / largest):.1g} of its size"
        problem = f"the residual can be predicted to {error}, it is constant or a few tones"
        raise SynthesisError(f"Shaping filter: {problem}; record longer or richer episodes.")
    root = vectors * np.sqrt(np.maximum(values, 0))
    A, B = basis.system(n)
    return StateSpace(A + B @ Theta, B @ root, Theta, root, dt)
