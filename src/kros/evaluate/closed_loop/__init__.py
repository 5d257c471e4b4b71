"""Loops that a controller closes over estimates: stability and worst errors for all units and for the uncertain set.

Examples
--------
>>> from kros.evaluate.closed_loop import Controller
>>> damper = Controller(D=[[-2.0]], sample_period_s=0.001, inputs=["velocity"], outputs=["voltage"])
>>> damper.outputs
('voltage',)
"""

from .controller import Controller
from .verdict import LoopResult, close_loop

__all__ = ["Controller", "LoopResult", "close_loop"]
