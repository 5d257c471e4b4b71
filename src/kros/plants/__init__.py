"""Simulated populations with known truth. Returns populations and truth; writing to disk is `kros.data`'s."""

from .dc_motor import DcMotorPopulation
from .harmonic_drive import HarmonicDrivePopulation
from .pendulum import PendulumPopulation
from .simulated import SimulatedPopulation

PLANTS = {"harmonic-drive": HarmonicDrivePopulation, "pendulum": PendulumPopulation, "dc-motor": DcMotorPopulation}

__all__ = ["PLANTS", "DcMotorPopulation", "HarmonicDrivePopulation", "PendulumPopulation", "SimulatedPopulation"]
