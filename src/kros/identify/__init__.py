"""Identification: phase calibration, triangular factors, EDMD, free run. The stage's result is a `ModelSet`."""

from .cross_validation import cross_validate
from .edmd import KoopmanMatrices, edmd, residual_covariance, smallest_stabilising_alpha
from .factors import Factor, combine, lifted_factor, reduce_episode
from .free_run import free_run
from .model_set import ModelSet
from .phase import PhaseCalibration, PhaseSpec, Segment, UnitPhase, find_segments, resolve_branches, unit_phase
from .scores import Scores, predict_ahead, score
from .selection import Choice, LeaveOut, Selection

__all__ = [
    "Choice",
    "Factor",
    "KoopmanMatrices",
    "LeaveOut",
    "ModelSet",
    "PhaseCalibration",
    "PhaseSpec",
    "Scores",
    "Segment",
    "Selection",
    "UnitPhase",
    "combine",
    "cross_validate",
    "edmd",
    "find_segments",
    "free_run",
    "lifted_factor",
    "predict_ahead",
    "reduce_episode",
    "residual_covariance",
    "resolve_branches",
    "score",
    "smallest_stabilising_alpha",
    "unit_phase",
]
