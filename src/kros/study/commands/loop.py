"""`kros loop`: whether a controller may use the estimates of a run's observer."""

from pathlib import Path

from ...core import read_json
from ...evaluate.closed_loop import Controller, LoopResult, close_loop
from ..engine.context import open_finished
from .field import load_observer


def judge_controller(run: Path, file: Path, observer: str = "deployed") -> LoopResult:
    """Judge the loop of a controller, a state space as JSON, over the estimates of an observer of a run."""
    controller = Controller.of(read_json(file), f"Controller {file}")
    with open_finished(run) as context:
        return close_loop(load_observer(context, observer), context.uncertain, controller)
