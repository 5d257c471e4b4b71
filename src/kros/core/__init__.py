"""Ground floor: systems, norms, artifacts and errors. Imports nothing else of kros.

Names are resolved on first use, so that importing the package stays cheap.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .lazy import lazy_names

if TYPE_CHECKING:
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
    from .lti import StateSpace, block_diagonal, gain
    from .norms import h2_norm, hinf_norm

_HOME = {
    **dict.fromkeys(
        (
            "ConfigError",
            "DataError",
            "DimensionError",
            "ExportError",
            "IdentificationError",
            "KrosError",
            "MissingDependencyError",
            "SynthesisError",
        ),
        "errors",
    ),
    **dict.fromkeys(("StateSpace", "block_diagonal", "gain"), "lti"),
    **dict.fromkeys(("h2_norm", "hinf_norm"), "norms"),
}

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

__getattr__, __dir__ = lazy_names(__name__, _HOME, __all__)
