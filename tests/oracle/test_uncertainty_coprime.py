"""Left coprime factors against what can be known otherwise: analytic cases, brute force over members, every observer that is tried."""

from __future__ import annotations

import numpy as np

from kros.core import StateSpace
from kros.observer.certificate.majorants import energy, majorants
from kros.observer.residual.signal_bounds import scaled_into, signal_lower_bounds
from kros.synthesis.residual_shaped.shaping_filter import Basis, circle_weights, shaping_filter
from kros.uncertainty.coprime.bands import BandEnergies
from kros.uncertainty.coprime.signals import SignalSet

RNG = np.random.default_rng(11)
DT = 0.01
F = np.array([[1.0, 0.1], [-0.1, 0.8]])
C = np.array([[1.0, 0.0]])


def residuals(units: int = 3, n: int = 2) -> tuple[np.ndarray, list[str]]:
    """Coloured signals of a size of their own on every unit."""
    w = RNG.standard_normal((400, units, n)) * np.linspace(0.5, 1.5, units)[:, None]
    return np.array([w[k] + 0.7 * w[k - 1] for k in range(1, 400)]), [f"u{i}" for i in range(units)]


def test_signals_keep_their_energy_and_the_start_is_a_sample() -> None:
    r, units = residuals()
    start = RNG.standard_normal((3, 2))
    found = SignalSet.of(r, [399] * 3, units, start)
    np.testing.assert_allclose(found.energies.mean_square, (np.sum(r**2, axis=0) + start**2) / 400, rtol=1e-9)
    mixed = found.spectrum(513, [0.2, 0.3, 0.5])
    energies = np.tensordot([0.2, 0.3, 0.5], found.energies.energy.sum(axis=1), 1)
    np.testing.assert_allclose(np.tensordot(circle_weights(513), mixed, 1).real, energies.real, rtol=1e-9, atol=1e-12)
    assert np.linalg.eigvalsh(found.cover.energy - found.energies.energy).min() > -1e-12


def closed(K: StateSpace) -> StateSpace:
    return StateSpace(
        np.block([[F - K.D @ C, -K.C], [K.B @ C, K.A]]),
        np.vstack([np.eye(2), np.zeros((K.n_states, 2))]),
        np.eye(2, 2 + K.n_states),
        np.zeros((2, 2)),
        DT,
    )


def test_no_observer_that_is_tried_falls_below_the_lower_bound_of_the_set() -> None:
    r, units = residuals()
    signals = SignalSet.of(r, [399] * 3, units, edges=np.linspace(0, np.pi, 31))
    noise = np.array([0.05])
    lower = signal_lower_bounds(F, C, noise, signals, DT)
    assert (lower > 0).all()
    best = np.full(2, np.inf)
    for _ in range(60):
        L = RNG.uniform([[0.3], [-0.6]], [[1.3], [0.4]])
        K = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((2, 0)), L, DT)
        T = closed(K)
        if T.is_stable():
            M = majorants(T, signals.energies.edges, signals.cover.energy)
            best = np.minimum(best, np.sqrt(energy(M, signals.cover.energy)))
    assert (lower <= best).all()
    assert (lower >= 0.1 * best).all()


def test_lower_bound_of_white_residuals_is_the_kalman_predictor_s() -> None:
    edges = np.linspace(0, np.pi, 9)
    signals = SignalSet(("u",), BandEnergies(edges, np.full((1, 8, 1, 1), 0.25 / 8)))
    a, q, v = 0.9, 0.25, 0.4
    p = q
    for _ in range(500):
        p = a * a * p * v / (p + v) + q
    found = signal_lower_bounds(np.array([[a]]), np.eye(1), np.array([np.sqrt(v)]), signals, DT)
    np.testing.assert_allclose(found, np.sqrt(p), rtol=2e-3)
    assert found[0] <= np.sqrt(p)


def test_a_filter_scaled_into_energies_is_inside_by_quadrature() -> None:
    r, units = residuals()
    signals = SignalSet.of(r, [399] * 3, units, edges=np.linspace(0, np.pi, 21))
    mean = signals.energies.energy.mean(axis=0)
    G = scaled_into(
        shaping_filter(signals.spectrum(513, np.full(3, 1 / 3)), Basis(4, (0.9,)), DT), signals.energies.edges, mean
    )
    theta = np.linspace(signals.energies.edges[:-1], signals.energies.edges[1:], 41, axis=-1)
    response = G.frequency_response(theta.ravel() / (2 * np.pi * DT)).reshape(20, 41, 2, -1)
    density = np.einsum("btik,btjk->btij", response, response.conj())
    inside = np.trapezoid(density, theta[..., None, None], axis=1) / np.pi
    root = np.linalg.inv(np.linalg.cholesky(mean))
    ratio = np.linalg.eigvalsh(root @ inside @ root.conj().swapaxes(-1, -2))
    assert 0.5 < ratio.max() <= 1 + 1e-6
