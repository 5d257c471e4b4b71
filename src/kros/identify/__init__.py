"""Identification: phase calibration, triangular factors, EDMD, free run. The stage's result is a `ModelSet`."""

from .bootstrap import ModelSamples, bootstrap_edmd, bootstrap_refined, episode_weights, one_step_deviations
from .calibration import PhaseCalibration, PhaseSpec, Segment, UnitPhase, find_segments, resolve_branches, unit_phase
from .edmd import KoopmanMatrices, edmd, residual_covariance, smallest_stabilising_alpha
from .episode_factors import episode_factors
from .factors import Factor, combine, lifted_factor, reduce_episode
from .free_run import free_run
from .model_set import ModelSet
from .ranges import Ranges

__all__ = [
    "Factor",
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
    "lifted_factor",
    "one_step_deviations",
    "reduce_episode",
    "residual_covariance",
    "resolve_branches",
    "smallest_stabilising_alpha",
    "unit_phase",
]
