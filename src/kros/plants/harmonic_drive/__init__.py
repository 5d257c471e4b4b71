"""Simulated motor drives with a Harmonic Drive gearbox, tuned to look like those of section IV.

`parameters` draws the drives, `reference` their trajectories, `dynamics` and `simulation` run them under `control`,
`linear` knows how the gearbox disturbance shows at constant speed, `population` puts it together.
"""

from .control import GAINS, Gains, Loop
from .parameters import GEAR_RATIO, NOMINAL, DriveParameters
from .population import HarmonicDrivePopulation
from .truth import Truth

__all__ = ["GAINS", "GEAR_RATIO", "NOMINAL", "DriveParameters", "Gains", "HarmonicDrivePopulation", "Loop", "Truth"]
