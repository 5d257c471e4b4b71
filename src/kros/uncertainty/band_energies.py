r"""Energies of signals in bands of frequency, exact for signals of finite length, and covers of many of them.

A residual ``r_0 ... r_{N-1}`` that is zero before and after has the spectrum ``R = sum_k r_k e^{-j k theta}``, and what
a stable T makes of it, for all time, has

.. math:: \sum_k |T r|_k^2 = \frac{1}{2\pi} \int_{-\pi}^{\pi} \mathrm{tr}(T^H T\, R R^H)\, d\theta
          \;\le\; \sum_b \mathrm{tr}(M_b \Phi_b), \qquad
          M_b \succeq T^H T \text{ throughout band } b, \qquad \Phi_b = \frac{1}{\pi} \int_b R R^H d\theta .

Signals and systems are real, so that the two signs of frequency contribute alike; bands are those of the positive one.
``R R^H`` is a polynomial in ``e^{j theta}`` whose coefficients are the autocorrelation, so its integral over a band is
a finite sum, taken as such: no window, no average, no samples of a spectrum between which something could stand out.
Start and tail are inside: the error at the start is a sample in front of the residual. What rounding may miss is added.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..core.linalg import adjoint
from .settings import BANDS

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class BandEnergies:
    """Energies of signals in bands of frequency, per sample."""

    edges: Array  # (b + 1,), rad per sample: increasing from zero to pi
    energy: Array  # (..., b, n, n)

    def __post_init__(self) -> None:
        edges, energy = check_edges(self.edges), np.asarray(self.energy, dtype=complex)
        if energy.ndim < 3 or energy.shape[-3:] != (len(edges) - 1, *energy.shape[-1:] * 2):
            raise DimensionError(f"Band energies: needs (..., {len(edges) - 1} bands, n, n), found {energy.shape}.")
        object.__setattr__(self, "edges", edges)
        object.__setattr__(self, "energy", energy)

    @classmethod
    def of(cls, signal: Array, lengths: npt.ArrayLike, edges: npt.ArrayLike) -> BandEnergies:
        """Return energies (batch, b, n, n) of the episodes of a signal (n_samples, batch, n)."""
        signal, lengths, edges = np.asarray(signal, dtype=float), np.asarray(lengths, dtype=int), check_edges(edges)
        fits = signal.ndim == 3 and lengths.shape == signal.shape[1:2]
        if not fits or not ((lengths > 0) & (lengths <= len(signal))).all():
            raise DimensionError(
                f"Band energies: {signal.shape} should be (n_samples, batch, n) with lengths between one and "
                f"n_samples, found {lengths}."
            )
        if not np.isfinite(signal).all():
            raise DimensionError("Band energies: the signal has NaN or infinity; look at the recordings and the model.")
        alone = np.where((np.arange(len(signal))[:, None] < lengths)[..., None], signal, 0.0)
        return cls(edges, np.array([*_energies(alone, edges)]) / lengths[:, None, None, None])

    def of_units(self, units: Sequence[str]) -> BandEnergies:
        """Return the mean over the episodes of every unit, units in order of appearance."""
        names = list(dict.fromkeys(units))
        member = np.array([[unit == name for unit in units] for name in names], dtype=float)
        return replace(self, energy=np.einsum("ue,ebij->ubij", member / member.sum(axis=1, keepdims=True), self.energy))


def band_edges(n_samples: int, bands: int = BANDS.bands) -> Array:
    """Return edges of bands, logarithmic from the lowest frequency of an episode to Nyquist, and one below."""
    if n_samples < 2 or bands < 2:
        raise DimensionError(f"Bands: needs at least two samples and two bands, found {n_samples} and {bands}.")
    return np.concatenate([[0.0], np.geomspace(2 * np.pi / max(n_samples, 4), np.pi, bands)[:-1], [np.pi]])


def check_edges(edges: npt.ArrayLike) -> Array:
    """Return edges as an array, or say why they make no bands."""
    values = np.asarray(edges, dtype=float)
    whole = values.ndim == 1 and len(values) > 1 and values[0] == 0 and np.isclose(values[-1], np.pi, rtol=1e-12)
    if not whole or not (np.diff(values) > 0).all():
        raise DimensionError(f"Bands: edges should increase from 0 to pi rad per sample, found {values}.")
    return values


def cover(energies: Array, weight: Array | None = None) -> Array:
    """Return what no energy (k, b, n, n) exceeds, of least `tr(weight M)`: Jezek et al., Phys. Rev. A 65 060301."""
    n = energies.shape[-1]
    mean = np.sqrt(np.einsum("kbii->bi", energies).real / len(energies))
    mean[mean <= 0] = 1.0
    outer = mean[:, :, None] * mean[:, None, :]
    half = np.eye(n)[None] if weight is None else _power(weight * outer, 0.5)
    back = np.linalg.inv(half)
    E = half @ (energies / outer) @ half
    size = np.maximum(np.einsum("kbii->kb", E).real.max(axis=0), np.finfo(float).tiny)[:, None, None]
    E = E / size + BANDS.ridge * np.eye(n)
    M = _least(np.ascontiguousarray(np.swapaxes(E, 0, 1)))
    M = (M + adjoint(M)) / 2
    total = E.sum(axis=0)  # covers in any case
    M = np.where((np.einsum("bii->b", total - M).real >= 0)[:, None, None], M, total)
    lacking = np.maximum(np.linalg.eigvalsh(E - M)[..., -1].max(axis=0), 0.0)
    grown, added = _touching(M, E), _touching(M + lacking[:, None, None] * np.eye(n), E)
    # Before it converges the symmetric part of M may be indefinite: no multiple of it covers then.
    smaller = (np.einsum("bii->b", grown - added).real < 0) & (np.linalg.eigvalsh(M)[..., 0] > 0)
    covers = back @ (np.where(smaller[:, None, None], grown, added) * size) @ back
    return np.asarray((covers + adjoint(covers)) / 2 * outer)


def _least(E: Array) -> Array:
    """Return the iteration's ``sum_k E_k Y_k`` in every band, for matrices (b, k, n, n)."""
    _, many, n = E.shape[:3]
    G = np.broadcast_to(np.eye(n) / np.sqrt(many), E.shape).astype(complex)  # Y_k = G_k^H G_k
    for _ in range(0, BANDS.iterations, BANDS.turns):
        for _ in range(BANDS.turns):
            rows = (G @ E).reshape(len(E), many * n, n)
            G = (rows @ _power(adjoint(rows) @ rows, -0.5)).reshape(E.shape)
        covers = (E @ (adjoint(G) @ G)).sum(axis=1)
        root = _power(covers, -0.5)[:, None]
        if np.linalg.eigvalsh(root @ E @ root)[..., -1].max() <= BANDS.enough:
            break
    return np.asarray(covers)


def _touching(M: Array, E: Array) -> Array:
    """Multiples of M that are just above all E."""
    root = _power(M, -0.5)
    return np.asarray(M * np.linalg.eigvalsh(root @ E @ root)[..., -1].max(axis=0)[:, None, None] * (1 + 1e-12))


def _power(matrices: Array, exponent: float) -> Array:
    """Powers of positive definite matrices."""
    values, vectors = np.linalg.eigh((matrices + adjoint(matrices)) / 2)
    values = np.maximum(values, BANDS.regular * np.maximum(values[..., -1:], np.finfo(float).tiny))
    return np.asarray((vectors * (values**exponent)[..., None, :]) @ adjoint(vectors))


def _energies(signals: Array, edges: Array) -> Iterator[Array]:
    """Yield integrals of ``R R^H / pi`` over bands, shape (b, n, n), for every signal of (n_samples, batch, n)."""
    n_samples, batch, n = signals.shape
    many = max(1, BANDS.at_once // (n_samples * n * n))
    for start in range(0, batch, many):
        some = signals[:, start : start + many]
        size = np.sqrt(np.sum(some**2, axis=0))
        size[size == 0] = 1.0
        outers = size[:, :, None] * size[:, None, :]
        for total, outer in zip(_integrals(_lags(some / size), edges), outers, strict=True):
            energy = np.diff(total, axis=0) / np.pi
            values, vectors = np.linalg.eigh(energy)
            positive = (vectors * np.maximum(values, 0.0)[:, None, :]) @ adjoint(vectors)
            yield (positive + BANDS.rounding * np.eye(n)) * outer


def _lags(signals: Array) -> Array:
    """Return ``sum_k r_{k+l} r_k^T`` for signals (n_samples, batch, n), shape (batch, n_samples, n, n)."""
    n_samples, batch, n = signals.shape
    points = 1 << (2 * n_samples - 1).bit_length()
    found = np.empty((batch, n_samples, n, n))
    for i in range(batch):
        R = np.fft.rfft(signals[:, i], points, axis=0)
        for j in range(n):
            for k in range(j + 1):
                both = np.fft.irfft(R[:, j] * R[:, k].conj(), points)
                found[i, :, j, k], found[i, :, k, j] = both[:n_samples], both[-np.arange(n_samples)]
    return found


def _integrals(lags: Array, edges: Array) -> Array:
    """Return the integrals from zero to every edge, shape (batch, edges, n, n)."""
    batch, n_samples, n, _ = lags.shape
    lags = lags.reshape(batch, n_samples, n * n)
    even, odd = np.zeros((2, batch, len(edges), n * n))
    for start in range(1, n_samples, BANDS.block):
        by_even, by_odd = _weights(edges.tobytes(), start, min(start + BANDS.block, n_samples))
        even += by_even @ lags[:, start : start + BANDS.block]
        odd += by_odd @ lags[:, start : start + BANDS.block]
    even, odd = (v.reshape(batch, len(edges), n, n) for v in (even, odd))
    whole = edges[:, None, None] * lags[:, :1].reshape(batch, 1, n, n)
    return whole + even + np.swapaxes(even, -1, -2) - 1j * (odd - np.swapaxes(odd, -1, -2))


@lru_cache(maxsize=4)
def _weights(edges: bytes, start: int, stop: int) -> tuple[Array, Array]:
    """Return the integrals of cosines and sines of some lags from zero to every edge."""
    lag = np.arange(start, stop)
    angle = np.frombuffer(edges)[:, None] * lag
    return np.sin(angle) / lag, 2 * np.sin(angle / 2) ** 2 / lag
