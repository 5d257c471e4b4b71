"""Ground floor: systems, norms, artifacts and errors. Imports nothing else of kros.

What needs NumPy is loaded on first use, so that importing the package stays cheap.

Examples
--------
>>> from kros.core import StateSpace, hinf_norm
>>> lag = StateSpace([[0.5]], [[0.5]], [[1.0]], [[0.0]], 0.01)  # 0.5 / (z - 0.5), every 0.01 s
>>> round(hinf_norm(lag), 9)
1.0
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .errors import (
    ConfigError,
    DataError,
    DimensionError,
    ExportError,
    IdentificationError,
    KrosError,
    MissingDependencyError,
    SynthesisError,
)
from .lazy import lazy_names

if TYPE_CHECKING:
    from .lti import StateSpace, block_diagonal, gain
    from .norms import h2_norm, hinf_norm

__all__ = [
    "ConfigError",
    "DataError",
    "DimensionError",
    "ExportError",
    "IdentificationError",
    "KrosError",
    "MissingDependencyError",
    "StateSpace",
    "SynthesisError",
    "block_diagonal",
    "gain",
    "h2_norm",
    "hinf_norm",
]

_HOME = {"StateSpace": "lti", "block_diagonal": "lti", "gain": "lti", "h2_norm": "norms", "hinf_norm": "norms"}
__getattr__, __dir__ = lazy_names(__name__, _HOME, __all__)
