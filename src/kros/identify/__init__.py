"""Identification: phase calibration, triangular factors, EDMD, free run. The stage's result is a `ModelSet`."""

from .bands import Bands, response_bands
from .bootstrap import ModelSamples, bootstrap_edmd, bootstrap_refined, episode_weights, one_step_deviations
from .cross_validation import cross_validate
from .edmd import KoopmanMatrices, edmd, residual_covariance, smallest_stabilising_alpha
from .episode_factors import episode_factors
from .factors import Factor, combine, lifted_factor, reduce_episode
from .free_run import free_run
from .model_set import ModelSet
from .phase import PhaseCalibration, PhaseSpec, Segment, UnitPhase, find_segments, resolve_branches, unit_phase
from .ranges import Ranges
from .scores import Scores, predict_ahead, score
from .selection import Choice, LeaveOut, Selection

__all__ = [
    "Bands",
    "Choice",
    "Factor",
    "KoopmanMatrices",
    "LeaveOut",
    "ModelSamples",
    "ModelSet",
    "PhaseCalibration",
    "PhaseSpec",
    "Ranges",
    "Scores",
    "Segment",
    "Selection",
    "UnitPhase",
    "bootstrap_edmd",
    "bootstrap_refined",
    "combine",
    "cross_validate",
    "edmd",
    "episode_factors",
    "episode_weights",
    "find_segments",
    "free_run",
    "lifted_factor",
    "one_step_deviations",
    "predict_ahead",
    "reduce_episode",
    "residual_covariance",
    "resolve_branches",
    "response_bands",
    "score",
    "smallest_stabilising_alpha",
    "unit_phase",
]
