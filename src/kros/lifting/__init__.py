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
from .kernels import Kernel, fourier_features, radial
from .lifting import Lifting

__all__ = [
    "Kernel",
    "Lifting",
    "concatenate",
    "delays",
    "formulas",
    "fourier_features",
    "grid_centres",
    "harmonics",
    "kmeans_centres",
    "latin_hypercube_centres",
    "polynomials",
    "products",
    "radial",
    "random_centres",
]
