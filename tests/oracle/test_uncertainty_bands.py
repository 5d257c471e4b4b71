"""Energies in bands against direct quadrature, and the bound that they make against what systems do to signals."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from kros.core import StateSpace
from kros.core.errors import DimensionError
from kros.uncertainty.band_energies import BandEnergies, band_edges, cover

RNG = np.random.default_rng(5)


def signals(n_samples: int = 60, batch: int = 3, n: int = 2) -> np.ndarray:
    white = RNG.standard_normal((n_samples, batch, n)) @ np.array([[1.0, 0.8], [0.0, 0.3]])[:n, :n]
    return np.cumsum(white, axis=0) + 3.0


def test_energies_are_the_integrals_of_the_spectrum() -> None:
    r, lengths = signals(), [60, 41, 7]
    edges = band_edges(60, 9)
    found = BandEnergies.of(r, lengths, edges).energy
    for i, length in enumerate(lengths):
        for b, (low, high) in enumerate(pairwise(edges)):
            x, w = np.polynomial.legendre.leggauss(80)
            theta, w = (high - low) / 2 * x + (high + low) / 2, (high - low) / 2 * w
            R = np.exp(-1j * theta[:, None] * np.arange(length)) @ r[:length, i]
            np.testing.assert_allclose(
                found[i, b], np.einsum("t,ta,tb->ab", w, R, R.conj()) / np.pi / length, rtol=1e-9, atol=1e-9
            )
        np.testing.assert_allclose(
            found[i].sum(axis=0).real, r[:length, i].T @ r[:length, i] / length, rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize("seed", range(3))
def test_a_cover_is_above_all_and_touches(seed: int) -> None:
    rng = np.random.default_rng(seed)
    G = rng.standard_normal((7, 4, 3, 3)) + 1j * rng.standard_normal((7, 4, 3, 3))
    E = G @ np.diag([1.0, 1e-2, 1e-8]) @ G.conj().swapaxes(-1, -2)
    M = cover(E)
    size = np.sqrt(np.einsum("bii->bi", M).real)
    ratio = np.linalg.eigvals(
        np.linalg.solve(M / size[:, :, None] / size[:, None, :], E / size[:, :, None] / size[:, None, :])
    ).real.max(axis=-1)
    assert ratio.max() <= 1 + 1e-6
    assert ratio.max(axis=0).min() > 0.999
    units = np.array([1e3, 1.0, 1e-4])
    np.testing.assert_allclose(cover(E * np.outer(units, units)), M * np.outer(units, units), rtol=1e-5, atol=1e-12)


def test_cover_of_scalars_is_their_maximum_and_of_commuting_matrices_that_of_entries() -> None:
    values = RNG.uniform(1, 9, (5, 6, 2))
    found = cover(values[..., None] * np.eye(2))
    np.testing.assert_allclose(np.einsum("bii->bi", found).real, values.max(axis=0), rtol=2e-2)
    np.testing.assert_allclose(cover(values[..., :1, None])[:, 0, 0].real, values[..., 0].max(axis=0), rtol=1e-5)


def test_bound_over_bands_holds_with_start_and_tail_and_is_close_for_fine_bands() -> None:
    system = StateSpace(np.array([[0.9, 0.2], [-0.2, 0.9]]), np.eye(2), np.array([[1.0, 0.5]]), np.zeros((1, 2)), 1.0)
    r = signals(80, 3)
    start = RNG.standard_normal((1, 3, 2))  # an error before the first sample
    driven = np.concatenate([start, r])
    output, x = np.zeros((2000, 3)), np.zeros((3, 2))
    for k in range(2000):
        output[k] = (x @ system.C.T)[:, 0]
        x = x @ system.A.T + (driven[k] if k < len(driven) else 0)
    actual = np.sum(output**2, axis=0) / 81
    excess = {}
    for bands in (50, 400):
        energies = BandEnergies.of(driven, [81] * 3, np.linspace(0, np.pi, bands + 1))
        inside = np.linspace(energies.edges[:-1], energies.edges[1:], 40, axis=-1)  # fine enough for a smooth T
        T = system.frequency_response(inside.ravel() / 2 / np.pi).reshape(bands, 40, 2)
        squares = np.einsum("bti,btj->tbij", T.conj(), T)
        best, some = (
            np.array(
                [
                    np.einsum("bij,bji->", cover(squares, w), phi).real
                    for w, phi in zip(weights, energies.energy, strict=True)
                ]
            )
            for weights in (energies.energy, [None] * 3)
        )
        assert (best >= actual / 1.001).all()
        assert (some >= best / 1.001).all()
        excess[bands] = best / actual - 1
    assert (excess[400] <= excess[50] / 4).all()
    assert excess[50].max() < 0.4


def test_what_is_no_signal_or_band_is_refused() -> None:
    with pytest.raises(DimensionError, match="lengths"):
        BandEnergies.of(signals(), [61, 3, 3], band_edges(60))
    with pytest.raises(DimensionError, match="edges"):
        BandEnergies.of(signals(), [60, 3, 3], [0.0, 1.0])
    with pytest.raises(DimensionError, match="bands"):
        BandEnergies(np.array([0.0, np.pi]), np.zeros((2, 2, 2)))
