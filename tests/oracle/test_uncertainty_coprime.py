"""Left coprime factors against what can be known otherwise: analytic cases, brute force over members, every observer that is tried."""

from __future__ import annotations

import numpy as np

from kros.core import StateSpace
from kros.synthesis.residual_shaped.shaping_filter import circle_weights
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
