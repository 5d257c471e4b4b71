"""Synthesis: from an uncertain model to a verified correction filter.

    UncertainModel --> ObserverProblem --> h2 | hinf | mixed | worst_case_h2 | worst_case_hinf | kalman --> Synthesis

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
    from .robust_gain import RobustGain, robust_gain
    from .shaped import residual_h2
    from .shaping import Bank, shaping_filter
    from .unit_check import UnitCheck, check_units
    from .worst_case import worst_case_h2
    from .worst_case_hinf import worst_case_hinf
    from .youla import YoulaBound, youla_bound

_HOME = {
    "Bank": "shaping",
    "Block": "mu_blocks",
    "GeneralizedPlant": "generalized_plant",
    "Injection": "result",
    "MuBounds": "mu",
    "ObserverProblem": "observer_problem",
    "RobustGain": "robust_gain",
    "Status": "result",
    "Synthesis": "result",
    "UnitCheck": "unit_check",
    "YoulaBound": "youla",
    "check_units": "unit_check",
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
    "robust_gain": "robust_gain",
    "shaping_filter": "shaping",
    "worst_case_h2": "worst_case",
    "worst_case_hinf": "worst_case_hinf",
    "youla_bound": "youla",
}

__all__ = [
    "Bank",
    "Block",
    "GeneralizedPlant",
    "Injection",
    "MuBounds",
    "ObserverProblem",
    "RobustGain",
    "Status",
    "Synthesis",
    "UnitCheck",
    "YoulaBound",
    "check_units",
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
    "robust_gain",
    "shaping_filter",
    "worst_case_h2",
    "worst_case_hinf",
    "youla_bound",
]

__getattr__, __dir__ = lazy_names(__name__, _HOME, __all__)
