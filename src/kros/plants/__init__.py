"""Simulated populations with known truth. Returns populations and truth; writing to disk is `kros.data`'s.

Examples
--------
>>> from kros.plants import DcMotorPopulation
>>> DcMotorPopulation(n_units=2, n_episodes=1, seconds=1.0).simulate().population.states
('position', 'velocity', 'current')
"""

from .batch import SimulatedPopulation
from .dc_motor import DcMotorPopulation
from .harmonic_drive.population import HarmonicDrivePopulation
from .pendulum import PendulumPopulation

PLANTS = {"harmonic-drive": HarmonicDrivePopulation, "pendulum": PendulumPopulation, "dc-motor": DcMotorPopulation}

__all__ = ["DcMotorPopulation", "HarmonicDrivePopulation", "PendulumPopulation", "SimulatedPopulation"]
