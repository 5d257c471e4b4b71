"""Simulated populations with known truth. Returns populations and truth; writing to disk is `kros.data`'s."""

from .harmonic_drive import HarmonicDrivePopulation
from .pendulum import PendulumPopulation
from .simulated import SimulatedPopulation

PLANTS = {"harmonic-drive": HarmonicDrivePopulation, "pendulum": PendulumPopulation}

__all__ = ["PLANTS", "HarmonicDrivePopulation", "PendulumPopulation", "SimulatedPopulation"]
