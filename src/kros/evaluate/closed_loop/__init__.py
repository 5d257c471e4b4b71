"""Loops that a controller closes over estimates: stability and worst errors for all units and for the uncertain set."""

from .controller import Controller
from .verdict import LoopResult, close_loop

__all__ = ["Controller", "LoopResult", "close_loop"]
