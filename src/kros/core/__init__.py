"""Ground floor: systems, norms, artifacts and errors. Imports nothing else of kros.

Names are resolved on first use, so that importing the package stays cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

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


def __getattr__(name: str) -> Any:
    """Import the module behind a public name when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted({*globals(), *__all__})
