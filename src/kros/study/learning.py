"""The stages from recordings to observers: all that is made again where units are left out."""

from __future__ import annotations

from .config import Stage
from .engine.steps import Step
from .stages import calibrate, identify, quantify, read, synthesize

LEARNING = (
    Step(Stage.READ, read.run, ("data", "split", "evaluate.reserve")),
    Step(Stage.CALIBRATE, calibrate.run, ("calibrate", "lifting")),
    Step(Stage.IDENTIFY, identify.run, ("identify", "lifting")),
    Step(Stage.QUANTIFY, quantify.run, ("uncertainty",)),
    Step(Stage.SYNTHESIZE, synthesize.run, ("synthesis", "predictor", "sensor", "limits", "observer", "require")),
)
