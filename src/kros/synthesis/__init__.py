"""Synthesis: from an uncertain model to a verified correction filter.

    UncertainModel --> ObserverProblem --> h2 | hinf | mixed | worst_case_h2 | kalman --> Synthesis

Nothing leaves this layer unverified: norms and stability are recomputed by `kros.core`, failure is a `SynthesisError` that says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazy_names

if TYPE_CHECKING:
    from .constant_gain import kalman, luenberger
    from .generalized_plant import GeneralizedPlant
    from .h2_optimal import h2
    from .hinf_optimal import hinf
    from .mixed_optimal import mixed
    from .observer_problem import ObserverProblem
    from .result import Injection, Status, Synthesis
    from .shaped import residual_h2
    from .shaping import Bank, shaping_filter
    from .worst_case import worst_case_h2

_HOME = {
    "Bank": "shaping",
    "GeneralizedPlant": "generalized_plant",
    "Injection": "result",
    "ObserverProblem": "observer_problem",
    "Status": "result",
    "Synthesis": "result",
    "h2": "h2_optimal",
    "hinf": "hinf_optimal",
    "kalman": "constant_gain",
    "luenberger": "constant_gain",
    "mixed": "mixed_optimal",
    "residual_h2": "shaped",
    "shaping_filter": "shaping",
    "worst_case_h2": "worst_case",
}

__all__ = [
    "Bank",
    "GeneralizedPlant",
    "Injection",
    "ObserverProblem",
    "Status",
    "Synthesis",
    "h2",
    "hinf",
    "kalman",
    "luenberger",
    "mixed",
    "residual_h2",
    "shaping_filter",
    "worst_case_h2",
]

__getattr__, __dir__ = lazy_names(__name__, _HOME, __all__)
