r"""Energies of signals in bands of frequency, exact for signals of finite length, and covers of many of them.

A residual ``r_0 ... r_{N-1}`` that is zero before and after has the spectrum ``R = sum_k r_k e^{-j k theta}``, and what a stable T makes of
it, for all time, has

.. math:: \sum_k |T r|_k^2 = \frac{1}{2\pi} \int_{-\pi}^{\pi} \mathrm{tr}(T^H T\, R R^H)\, d\theta \;\le\; \sum_b \mathrm{tr}(M_b \Phi_b), \qquad
          M_b \succeq T^H T \text{ throughout band } b, \qquad \Phi_b = \frac{1}{\pi} \int_b R R^H d\theta .

Signals and systems are real, so that the two signs of frequency contribute alike; bands are those of the positive one. ``R R^H`` is a
polynomial in ``e^{j theta}`` whose coefficients are the autocorrelation, so its integral over a band is a finite sum, taken as such: no window, no average,
no samples of a spectrum between which something could stand out. Start and tail are inside: the error at the start is a sample in front of the residual.
What rounding may miss is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...core.linalg import adjoint

Array = npt.NDArray[Any]
BANDS = 96
_ROUNDING = 1e-13  # of a channel's energy: correlations by FFT and their sums with weights below 2 / lag
_ITERATIONS = 60
_REGULAR = 1e-14  # of the largest eigenvalue: what is smaller is rounding
_RIDGE = 1e-6  # of the largest energy, in every direction: where all lie in fewer of them, the iteration needs its square above rounding


@dataclass(frozen=True, eq=False)
class BandEnergies:
    """Energies of signals in bands of frequency, per sample.

    Parameters
    ----------
    edges : ndarray, shape (b + 1,), rad per sample
        Increasing from zero to pi.
    energy : ndarray, shape (..., b, n, n), complex Hermitian
        ``Phi_b`` over the number of samples, both signs of frequency folded in: the traces of all bands sum to the mean square of a sample.
        Leading axes are episodes or units; none for a cover.
    """

    edges: Array
    energy: Array

    def __post_init__(self) -> None:
        edges, energy = check_edges(self.edges), np.asarray(self.energy, dtype=complex)
        if energy.ndim < 3 or energy.shape[-3] != len(edges) - 1 or energy.shape[-1] != energy.shape[-2]:
            raise DimensionError(f"Band energies: needs (..., {len(edges) - 1}, n, n) for as many bands, found {energy.shape}.")
        object.__setattr__(self, "edges", edges)
        object.__setattr__(self, "energy", energy)

    @classmethod
    def of(cls, signal: Array, lengths: npt.ArrayLike, edges: npt.ArrayLike, samples: npt.ArrayLike | None = None) -> BandEnergies:
        """Return the energies of every episode, exact for signals that are zero before and after.

        Parameters
        ----------
        signal : ndarray, shape (n_samples, batch, n)
        lengths : array_like of int, shape (batch,)
            Samples of every episode that count; what follows is taken as zero.
        edges : array_like, shape (b + 1,), rad per sample
        samples : array_like, shape (batch,), optional
            What energies are divided by: the samples over which an error is averaged. Default is `lengths`.

        Returns
        -------
        BandEnergies
            With energies of shape (batch, b, n, n).
        """
        signal, lengths, edges = np.asarray(signal, dtype=float), np.asarray(lengths, dtype=int), check_edges(edges)
        if signal.ndim != 3 or lengths.shape != signal.shape[1:2] or not ((lengths > 0) & (lengths <= len(signal))).all():
            raise DimensionError(
                f"Band energies: {signal.shape} should be (n_samples, batch, n) with lengths between one and n_samples, found {lengths}."
            )
        if not np.isfinite(signal).all():
            raise DimensionError("Band energies: the signal contains NaN or infinity; look at the recordings and the model.")
        alone = np.where((np.arange(len(signal))[:, None] < lengths)[..., None], signal, 0.0)
        found = [_energies(alone[:, i], edges) for i in range(len(lengths))]  # one at a time: lags of all would not fit in memory
        return cls(edges, np.array(found) / np.asarray(lengths if samples is None else samples, dtype=float)[:, None, None, None])

    def of_units(self, units: Sequence[str]) -> BandEnergies:
        """Return the mean over the episodes of every unit, units in order of appearance; `units` names that of every episode."""
        names = list(dict.fromkeys(units))
        member = np.array([[unit == name for unit in units] for name in names], dtype=float)
        return replace(self, energy=np.einsum("ue,ebij->ubij", member / member.sum(axis=1, keepdims=True), self.energy))

    def scaled(self, size: npt.ArrayLike) -> BandEnergies:
        """Return the energies of the signals divided by sizes of their channels, shape (n,)."""
        size = np.asarray(size, dtype=float)
        return replace(self, energy=self.energy / np.outer(size, size))

    def cover(self) -> BandEnergies:
        """Return energies that are no smaller than those of any episode or unit, in every band and direction."""
        n = self.energy.shape[-1]
        return replace(self, energy=cover(self.energy.reshape(-1, len(self.edges) - 1, n, n)))

    @property
    def mean_square(self) -> Array:
        """Mean square of every channel, shape (..., n)."""
        return np.asarray(np.einsum("...bii->...i", self.energy).real)


def band_edges(n_samples: int, bands: int = BANDS) -> Array:
    """Return edges of bands: one from zero to the lowest frequency of an episode, the others equally wide on a logarithmic scale up to Nyquist."""
    if n_samples < 2 or bands < 2:
        raise DimensionError(f"Bands: needs at least two samples and two bands, found {n_samples} and {bands}.")
    return np.concatenate([[0.0], np.geomspace(2 * np.pi / max(n_samples, 4), np.pi, bands)[:-1], [np.pi]])


def check_edges(edges: npt.ArrayLike) -> Array:
    """Return edges as an array, or say why they make no bands."""
    found = np.asarray(edges, dtype=float)
    if found.ndim != 1 or len(found) < 2 or found[0] != 0 or not np.isclose(found[-1], np.pi, rtol=1e-12) or not (np.diff(found) > 0).all():
        raise DimensionError(f"Bands: edges should increase from 0 to pi rad per sample, found {found}.")
    return found


def cover(energies: Array, weight: Array | None = None) -> Array:
    r"""Return a matrix in every band that is no smaller than any of those given.

    Least is ``tr(weight M)`` subject to ``M >= E_k``, for which the dual ``max sum_k tr(E_k Y_k)``, ``sum_k Y_k = 1``, ``Y_k >= 0`` is solved by the
    fixed-point iteration of optimal measurements [1]_; there ``M = sum_k E_k Y_k``. That is enlarged until it covers, so it does whatever the
    iteration has reached.

    Parameters
    ----------
    energies : ndarray, shape (k, b, n, n)
        Positive semidefinite.
    weight : ndarray, shape (b, n, n), optional
        Positive definite: what the cover is for. By default every channel counts by the inverse of its mean, so that units of measure change nothing.

    Returns
    -------
    ndarray, shape (b, n, n)

    References
    ----------
    .. [1] M. Jezek, J. Rehacek and J. Fiurasek, "Finding optimal strategies for minimum-error quantum-state discrimination",
       Physical Review A 65 (2002) 060301.
    """
    n = energies.shape[-1]
    mean = np.sqrt(np.einsum("kbii->bi", energies).real / len(energies))
    mean[mean <= 0] = 1.0
    outer = mean[:, :, None] * mean[:, None, :]
    half = np.eye(n)[None] if weight is None else _power(weight * outer, 0.5)
    back = np.linalg.inv(half)
    E = half @ (energies / outer) @ half
    size = np.maximum(np.einsum("kbii->kb", E).real.max(axis=0), np.finfo(float).tiny)[:, None, None]
    E = E / size + _RIDGE * np.eye(n)
    F = np.broadcast_to(np.eye(n) / np.sqrt(len(E)), E.shape).astype(complex)  # Y_k = F_k F_k^H
    for _ in range(_ITERATIONS):
        F = E @ F
        F = _power((F @ adjoint(F)).sum(axis=0), -0.5) @ F
    M = (E @ F @ adjoint(F)).sum(axis=0)
    M = (M + adjoint(M)) / 2
    total = E.sum(axis=0)  # covers in any case
    M = np.where((np.einsum("bii->b", total - M).real >= 0)[:, None, None], M, total)
    lacking = np.maximum(np.linalg.eigvalsh(E - M)[..., -1].max(axis=0), 0.0)
    grown, added = _touching(M, E), _touching(M + lacking[:, None, None] * np.eye(n), E)
    # Before it converges the symmetric part of M may be indefinite: no multiple of it covers then.
    smaller = (np.einsum("bii->b", grown - added).real < 0) & (np.linalg.eigvalsh(M)[..., 0] > 0)
    found = back @ (np.where(smaller[:, None, None], grown, added) * size) @ back
    return np.asarray((found + adjoint(found)) / 2 * outer)


def _touching(M: Array, E: Array) -> Array:
    """Multiples of M that are just above all E."""
    root = _power(M, -0.5)
    return np.asarray(M * np.linalg.eigvalsh(root @ E @ root)[..., -1].max(axis=0)[:, None, None] * (1 + 1e-12))


def _power(matrices: Array, exponent: float) -> Array:
    """Powers of positive definite matrices."""
    values, vectors = np.linalg.eigh((matrices + adjoint(matrices)) / 2)
    values = np.maximum(values, _REGULAR * np.maximum(values[..., -1:], np.finfo(float).tiny))
    return np.asarray((vectors * (values**exponent)[..., None, :]) @ adjoint(vectors))


def _energies(signal: Array, edges: Array) -> Array:
    """Integrals of ``R R^H / pi`` over bands, for one signal (n_samples, n); shape (b, n, n)."""
    n_samples, n = signal.shape
    size = np.sqrt(np.sum(signal**2, axis=0))
    size[size == 0] = 1.0
    points = 1 << (2 * n_samples - 1).bit_length()
    R = np.fft.rfft(signal / size, points, axis=0)
    lags = np.fft.irfft(R[:, :, None] * R[:, None, :].conj(), points, axis=0)[:n_samples].reshape(n_samples, n * n)  # sum_k r_{k+l} r_k^T
    lag = np.arange(1, n_samples)
    total = np.empty((len(edges), n, n), complex)  # integral from zero to the edge
    for i, edge in enumerate(edges):
        half = (((1 - np.exp(-1j * edge * lag)) / (1j * lag)) @ lags[1:]).reshape(n, n)
        total[i] = edge * lags[0].reshape(n, n) + half + half.conj().T
    energy = np.diff(total, axis=0) / np.pi
    values, vectors = np.linalg.eigh(energy)
    positive = (vectors * np.maximum(values, 0.0)[:, None, :]) @ adjoint(vectors)
    return np.asarray((positive + _ROUNDING * np.eye(n)) * np.outer(size, size))
