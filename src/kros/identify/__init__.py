"""Identification: from recordings to models of every unit. ``kros.identify(population)`` calls the verb `identify`.

Python binds a package's name to the package, so the package itself is made callable.

Examples
--------
>>> import kros
>>> drives = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
>>> kros.identify(drives, refine=False).kinds
('linear_edmd',)
"""

import sys
from types import ModuleType

from .calibration import PhaseCalibration, PhaseSpec
from .edmd import KoopmanMatrices, edmd, smallest_stabilising_alpha
from .factors import Factor, combine, unit_factors
from .free_run import free_run
from .identified import IdentifiedModels
from .identify import identify
from .model_set import ModelSet

__all__ = [
    "Factor",
    "IdentifiedModels",
    "KoopmanMatrices",
    "ModelSet",
    "PhaseCalibration",
    "PhaseSpec",
    "combine",
    "edmd",
    "free_run",
    "identify",
    "smallest_stabilising_alpha",
    "unit_factors",
]


class _CallablePackage(ModuleType):
    """The package, which called is its verb."""

    __call__ = staticmethod(identify)


sys.modules[__name__].__class__ = _CallablePackage
