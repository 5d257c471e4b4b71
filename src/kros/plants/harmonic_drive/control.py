"""The drive's software: encoder, velocity estimate and cascaded position-velocity control, the same in every unit.

target position --> (+) --> Kp --> (+) --> PI --> limit --> current
                    -|    target velocity +|  -|
              position                     velocity = filtered difference of position
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from .parameters import GEAR_RATIO

SAMPLE_PERIOD_S = 1e-3
ENCODER_COUNTS = 2**15  # per revolution of the motor
COUNT_RAD = 2 * np.pi / (ENCODER_COUNTS * GEAR_RATIO)  # at the gearbox output
VELOCITY_POLE = float(np.exp(-2 * np.pi * 150.0 * SAMPLE_PERIOD_S))  # first-order filter at 150 Hz
CURRENT_NOISE = 2e-3  # standard deviation, fraction of full scale


class Loop(str, Enum):
    """How stiff the velocity loop is."""

    STIFF = "stiff"
    SOFT = "soft"


@dataclass(frozen=True)
class Gains:
    """Controller gains."""

    position: float  # 1/s
    velocity: float  # fraction of full scale per rad/s
    integral: float  # fraction of full scale per rad
    antiwindup: float = 0.05  # share of the excess over the current limit that is taken off the integrator each sample


GAINS = {
    Loop.STIFF: Gains(position=25.0, velocity=3.75, integral=110.0),
    Loop.SOFT: Gains(position=15.0, velocity=1.5, integral=25.0),
}
