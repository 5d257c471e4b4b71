"""Synthesis: from an uncertain model to a verified correction filter.

    UncertainModel --> ObserverProblem --> h2 | hinf | mixed | worst_case_h2 | kalman --> Synthesis

Nothing leaves this layer unverified: norms and stability are recomputed by `kros.core`, failure is a `SynthesisError`
that says why.

Examples
--------
>>> from kros.synthesis import kalman
>>> float(kalman([[1.0]], [[1.0]], [[1.0]], [[2.0]]).controller.D[0, 0])  # P = 2, L = 2 / (2 + 2)
0.5
"""

from .generalized_plant import GeneralizedPlant
from .mixed_norms.mixed import mixed
from .problem.observer_problem import ObserverProblem
from .result import Injection, Status, Synthesis
from .riccati.h2 import h2, kalman
from .riccati.hinf import hinf
from .worst_case.worst_case_h2 import worst_case_h2

__all__ = [
    "GeneralizedPlant",
    "Injection",
    "ObserverProblem",
    "Status",
    "Synthesis",
    "h2",
    "hinf",
    "kalman",
    "mixed",
    "worst_case_h2",
]
