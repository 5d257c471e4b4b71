"""Loops of controllers that use estimates: judged for every unit, and for the uncertain set.

    controller, observer, uncertain models --the perturbation in the loop, all units simulated--> margin and verdict

>>> from kros.evaluate.closed_loop import Controller
>>> damper = {"D": [[-2.0]], "sample_period_s": 0.001, "inputs": ["velocity"], "outputs": ["voltage"]}
>>> Controller.of(damper, "Controller").system.n_states
0
"""

from .close_loop import LoopResult, LoopStatus, close_loop
from .controller import Controller

__all__ = ["Controller", "LoopResult", "LoopStatus", "close_loop"]
