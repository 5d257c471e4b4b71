"""Problems of any size for the benchmarks: recordings, responses of a population, plants and observers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from kros import from_arrays
from kros.core import StateSpace, gain
from kros.core.frequency import log_grid
from kros.data import EpisodeKey, Population, Unit
from kros.lifting import Lifting
from kros.observer import Observer
from kros.plants import HarmonicDrivePopulation
from kros.synthesis import GeneralizedPlant, Injection

Array = npt.NDArray[np.float64]
DT = 1e-3
STATES = ("position", "velocity", "current")
QUADRATIC = Lifting(
    STATES, tuple(f"{a}*{b}" for i, a in enumerate(STATES) for b in STATES[i:])
)  # as pykoop orders them
GEAR = Lifting(STATES, ("sin(100*position + phase)",), ("phase",))


def wide(n_lifted: int) -> Lifting:
    """Return three states with as many sines and cosines as make a number of lifted states."""
    functions = [f"{f}({k}*{s})" for k in range(1, n_lifted) for s in STATES for f in ("sin", "cos")]
    return Lifting(STATES, tuple(functions[: n_lifted - 3]))


def recording(n_samples: int, seed: int = 0) -> tuple[Array, Array]:
    """Return states and inputs of one episode."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n_samples, 3)).cumsum(axis=0) * 1e-2, rng.normal(size=(n_samples, 2))


def raw_drives(n_episodes: int, seconds: float = 19.0) -> Population:
    """Return one simulated drive as recorded."""
    raw = HarmonicDrivePopulation(n_units=1, n_episodes=2, seconds=seconds, conditions=("noload",)).simulate().raw
    two = [raw.read(key) for key in raw.episodes]
    data = {EpisodeKey("000000", "noload", str(e)): two[e % 2] for e in range(n_episodes)}
    units = (Unit("000000", "population"),)
    return from_arrays(data, raw.channels, raw.sample_period_s, units=units, metadata=raw.metadata)


def lags(n_units: int, seed: int = 0) -> StateSpace:
    """Return coupled lags with four outputs and two inputs, as identified models are.

    Every unit is a random convex combination of twelve and a few percent of its own on poles and gains, which keeps it stable: poles move in the
    magnitude of their time constants, never across the unit circle.
    """
    rng = np.random.default_rng(seed)
    corners = np.array([1.0, 5.0, 20.0, 80.0]) * np.exp(0.15 * rng.normal(size=(12, 4)))
    mixing = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    gains = rng.normal(size=(4, 2)) * (1 + 0.1 * rng.normal(size=(12, 4, 2)))
    share = rng.dirichlet(0.5 * np.ones(12), n_units)
    poles = np.exp(-2 * np.pi * DT * np.exp(share @ np.log(corners)) * np.exp(0.02 * rng.normal(size=(n_units, 4))))
    A = mixing @ (poles[:, :, None] * np.eye(4)) @ np.linalg.inv(mixing)
    B = (np.eye(4) - A) @ (np.einsum("nk,kij->nij", share, gains) * (1 + 0.02 * rng.normal(size=(n_units, 4, 2))))
    return StateSpace(A, B, np.broadcast_to(np.eye(4), A.shape), np.zeros(B.shape), DT)


def responses(n_units: int, n_freqs: int = 1000, outputs: int = 4) -> npt.NDArray[np.complex128]:
    """Return the responses of lags, shape (unit, frequency, output, 2)."""
    units, freqs = lags(n_units), log_grid(DT, n_freqs)
    return np.concatenate([units[i : i + 50].frequency_response(freqs)[:, :, :outputs] for i in range(0, n_units, 50)])


def plant(n: int, dt: float = 0.0, seed: int = 0) -> GeneralizedPlant:
    """Return a regular plant of n states: two performance outputs and disturbances, two controls and two noisy measurements."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) / np.sqrt(n)
    A = A - 0.5 * np.eye(n) if dt == 0 else 0.95 * A / np.abs(np.linalg.eigvals(A)).max()
    zero, one = np.zeros((2, 2)), np.eye(2)
    B1, C1 = (
        np.hstack([rng.normal(size=(n, 2)), np.zeros((n, 2))]),
        np.vstack([rng.normal(size=(2, n)), np.zeros((2, n))]),
    )
    D12, D21 = np.vstack([zero, one]), np.hstack([zero, one])
    return GeneralizedPlant(
        A, B1, rng.normal(size=(n, 2)), C1, rng.normal(size=(2, n)), np.zeros((4, 4)), D12, D21, zero, dt
    )


def two_channels() -> GeneralizedPlant:
    """Return a plant whose constraint, an H-infinity norm below one in the second channel, forbids the H2 optimum by five percent."""
    first, rng, zero = plant(6, 1.0, 3), np.random.default_rng, np.zeros
    B1 = np.hstack([first.B1, 1.536 * rng(4).normal(size=(6, 1))])
    C1 = np.vstack([first.C1, 0.024 * rng(5).normal(size=(1, 6))])
    D12, D21 = np.vstack([first.D12, zero((1, 2))]), np.hstack([first.D21, zero((2, 1))])
    return replace(first, B1=B1, C1=C1, D11=zero((5, 5)), D12=D12, D21=D21, n_w1=4, n_z1=4)


def observer(lifting: Lifting, order: int = 0) -> Observer:
    """Return a stable observer of the position with a correction filter of an order."""
    rng = np.random.default_rng(order)
    n = lifting.n_lifted
    K = gain(0.01 * np.ones((n, 1)), DT)
    if order:
        K = StateSpace(0.5 * np.eye(order), rng.normal(size=(order, 1)), 0.01 * rng.normal(size=(n, order)), K.D, DT)
    A, B = 0.5 * np.linalg.qr(rng.normal(size=(n, n)))[0], rng.normal(size=(n, 2))
    return Observer("o", lifting, A, B, (0,), ("target_position", "target_velocity"), K, Injection.STATE, DT)
