"""Observer design: from uncertain models to an observer, by any method, with what is certified about it.

Examples
--------
>>> import kros
>>> from kros.plants import DcMotorPopulation
>>> motors = DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
>>> uncertain = kros.quantify(kros.identify(motors, refine=False), n_freqs=50)
>>> kros.design.synthesize(uncertain, method="kalman_tuned", methods=()).name
'linear_edmd/kalman_tuned'
"""

from .synthesize import synthesize
from .task import Design

__all__ = ["Design", "synthesize"]
