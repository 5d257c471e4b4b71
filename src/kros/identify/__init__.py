"""Identification: from recordings to models of every unit. ``kros.identify(population)`` calls the verb `identify` of this package.

Python binds a package's name to the package, so the package itself is made callable.

Examples
--------
>>> import kros
>>> drives = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
>>> kros.identify(drives, refine=False).kinds
('linear_edmd',)
"""

import sys
from types import ModuleType

from .bootstrap import ModelSamples, bootstrap_edmd, bootstrap_refined, episode_weights, one_step_deviations
from .calibration import PhaseCalibration, PhaseSpec, Segment, UnitPhase, find_segments, resolve_branches, unit_phase
from .edmd import KoopmanMatrices, edmd, residual_covariance, smallest_stabilising_alpha
from .factors import Factor, combine, episode_factors, lifted_factor, reduce_episode
from .free_run import free_run
from .identified import EpisodeFactors, IdentifiedModels
from .identify import identify
from .model_set import ModelSet
from .ranges import Ranges

__all__ = [
    "EpisodeFactors",
    "Factor",
    "IdentifiedModels",
    "KoopmanMatrices",
    "ModelSamples",
    "ModelSet",
    "PhaseCalibration",
    "PhaseSpec",
    "Ranges",
    "Segment",
    "UnitPhase",
    "bootstrap_edmd",
    "bootstrap_refined",
    "combine",
    "edmd",
    "episode_factors",
    "episode_weights",
    "find_segments",
    "free_run",
    "identify",
    "lifted_factor",
    "one_step_deviations",
    "reduce_episode",
    "residual_covariance",
    "resolve_branches",
    "smallest_stabilising_alpha",
    "unit_phase",
]


class _CallablePackage(ModuleType):
    """The package, which called is its verb."""

    __call__ = staticmethod(identify)


sys.modules[__name__].__class__ = _CallablePackage
