"""The stages from recordings to observers: what is repeated where units are left out."""

from __future__ import annotations

from .config import Stage
from .engine.steps import StageStep
from .stages import calibrate, identify, quantify, read, synthesize

LEARNING = (
    StageStep(Stage.READ, read.run, ("data", "split", "evaluate.reserve")),
    StageStep(Stage.CALIBRATE, calibrate.run, ("calibrate", "lifting")),
    StageStep(Stage.IDENTIFY, identify.run, ("identify", "lifting")),
    StageStep(Stage.QUANTIFY, quantify.run, ("uncertainty",)),
    StageStep(Stage.SYNTHESIZE, synthesize.run, ("synthesis", "estimator", "sensor", "observer")),
)
