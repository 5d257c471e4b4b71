"""Liftings as formulas: evaluate, differentiate, separate from per-unit parameters, write as C."""

from .formula import Formula, parse
from .lifting import Lifting, Separation

__all__ = ["Formula", "Lifting", "Separation", "parse"]
