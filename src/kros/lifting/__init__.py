"""Liftings as formulas: evaluate, differentiate, bound, separate from per-unit parameters, write as C."""

from .formula import Formula, parse
from .lifting import Lifting
from .separation import Separation
from .window import Window

__all__ = ["Formula", "Lifting", "Separation", "Window", "parse"]
