"""Liftings as formulas: build, evaluate, differentiate, bound, separate from per-unit parameters, write as C.

Examples
--------
>>> from kros.lifting import Lifting
>>> gearbox = Lifting(("position", "velocity"), ("sin(100*position + phase)",), parameters=("phase",))
>>> gearbox.lift([[0.0, 3.0]], {"phase": 0.0}).tolist()
[[0.0, 3.0, 0.0]]
"""

from .centres import grid_centres, kmeans_centres, latin_hypercube_centres, random_centres
from .families import concatenate, delays, formulas, harmonics, polynomials, products
from .formula import Formula, parse
from .kernels import Kernel, Radial, fourier_features, radial
from .lifting import Lifting
from .separation import Separation
from .tables import check_family, family
from .window import Window

__all__ = [
    "Formula",
    "Kernel",
    "Lifting",
    "Radial",
    "Separation",
    "Window",
    "check_family",
    "concatenate",
    "delays",
    "family",
    "formulas",
    "fourier_features",
    "grid_centres",
    "harmonics",
    "kmeans_centres",
    "latin_hypercube_centres",
    "parse",
    "polynomials",
    "products",
    "radial",
    "random_centres",
]
