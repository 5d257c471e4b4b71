"""Liftings as formulas: build, evaluate, differentiate, bound, separate from per-unit parameters, write as C.

Examples
--------
>>> from kros.lifting import Lifting
>>> gearbox = Lifting(("position", "velocity"), ("sin(100*position + phase)",), parameters=("phase",))
>>> gearbox.lift([[0.0, 3.0]], {"phase": 0.0}).tolist()
[[0.0, 3.0, 0.0]]
"""

from .families import delays, harmonics, kmeans_centres, polynomials, radial
from .lifting import Lifting

__all__ = ["Lifting", "delays", "harmonics", "kmeans_centres", "polynomials", "radial"]
