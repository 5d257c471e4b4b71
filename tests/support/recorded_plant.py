"""Recordings of a second-order plant of which the position is measured, and few settings for estimators of it."""

from __future__ import annotations

import numpy as np

from kros.data import EpisodeBatch, EpisodeKey
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Recordings, identify_estimator
from kros.plants import DcMotorPopulation

FEW = EstimatorSettings(rows=4000, sample=1500, delays=20, gap_samples=1200, gap_episodes=4)
DT = 0.01


def plant(units=4, episodes=3, samples=400, spread=0.0):
    """Return recordings of a second-order plant of which the position is measured; hidden are its velocity and a lag of the input."""
    rng, batches = np.random.default_rng(0), {}
    for unit in range(units):
        factor = 1 + spread * rng.normal()
        A, B = np.array([[1, 0.1, 0], [-0.1 * factor, 0.8, 0.2], [0, 0, 0.9]]), np.array([0.0, 0.0, 0.1])
        for episode in range(episodes):
            u = np.convolve(rng.normal(size=samples), np.ones(10) / 3, "same")
            x = np.zeros((samples, 3))
            for k in range(samples - 1):
                x[k + 1] = A @ x[k] + B * u[k]
            key = EpisodeKey(f"{unit}", "", f"{episode}")
            batches[key] = EpisodeBatch((key,), np.array([samples]), x[:, None], u[:, None, None], DT)
    return Recordings.of(list(batches), batches.__getitem__), batches


LIFTING = Lifting(("position", "velocity", "force"))


def recorded_motors(units=3, episodes=3):
    """Return DC motors for a second at 1 kHz, and their recordings."""
    simulated = DcMotorPopulation(n_units=units, n_episodes=episodes, seconds=1.0, seed=3).simulate()
    population = simulated.population
    return population, Recordings.of(list(population.keys()), lambda key: EpisodeBatch.read(population, [key]))


def estimator(recordings, lifting=LIFTING, measured=(0,), inputs=("u",), dt=DT, settings=FEW):
    """Return the observer that is identified from recordings."""
    return identify_estimator("test", lifting, measured, inputs, recordings, dt, settings=settings).observer
