"""Synthesis: from an uncertain model to a verified correction filter.

    UncertainModel --> ObserverProblem --> h2 | hinf | mixed | worst_case_h2 | kalman --> Synthesis

Nothing leaves this layer unverified: norms and stability are recomputed by `kros.core`, failure is a `SynthesisError` that says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazy_names

if TYPE_CHECKING:
    from .constant_gain import kalman, luenberger
    from .dk import dk_iteration
    from .generalized_plant import GeneralizedPlant
    from .h2_optimal import h2
    from .hinf_optimal import hinf
    from .mixed_optimal import mixed
    from .mu import MuBounds, mu_bounds, mu_lower, mu_upper
    from .mu_blocks import Block
    from .observer_problem import ObserverProblem
    from .polishing import polish
    from .reduction import reduce_controller
    from .result import Injection, Status, Synthesis
    from .shaped import residual_h2
    from .shaping import Bank, shaping_filter
    from .worst_case import worst_case_h2

_HOME = {
    "Bank": "shaping",
    "Block": "mu_blocks",
    "GeneralizedPlant": "generalized_plant",
    "Injection": "result",
    "MuBounds": "mu",
    "ObserverProblem": "observer_problem",
    "Status": "result",
    "Synthesis": "result",
    "dk_iteration": "dk",
    "h2": "h2_optimal",
    "hinf": "hinf_optimal",
    "kalman": "constant_gain",
    "luenberger": "constant_gain",
    "mixed": "mixed_optimal",
    "mu_bounds": "mu",
    "mu_lower": "mu",
    "mu_upper": "mu",
    "polish": "polishing",
    "reduce_controller": "reduction",
    "residual_h2": "shaped",
    "shaping_filter": "shaping",
    "worst_case_h2": "worst_case",
}

__all__ = [
    "Bank",
    "Block",
    "GeneralizedPlant",
    "Injection",
    "MuBounds",
    "ObserverProblem",
    "Status",
    "Synthesis",
    "dk_iteration",
    "h2",
    "hinf",
    "kalman",
    "luenberger",
    "mixed",
    "mu_bounds",
    "mu_lower",
    "mu_upper",
    "polish",
    "reduce_controller",
    "residual_h2",
    "shaping_filter",
    "worst_case_h2",
]

__getattr__, __dir__ = lazy_names(__name__, _HOME, __all__)
