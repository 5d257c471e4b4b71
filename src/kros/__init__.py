"""Koopman robust observer synthesis.

Recordings of nominally identical machines go in; one observer that works on all of them comes out, with a statement of
how well and why.

    recordings --read--> population --identify--> models --quantify--> uncertain models --synthesize--> observer

Importing this package imports nothing else: ``kros.synthesis``, ``kros.data`` and the others load when first used.
"""

from importlib import import_module
from typing import Any

_FLOW = ("core", "data", "plants", "lifting", "identify", "uncertainty", "synthesis", "design", "observer")
_SUBPACKAGES = tuple(sorted((*_FLOW, "motor_drive", "evaluate", "export", "interop", "report", "study")))
_VERBS = {"read": "data", "from_arrays": "data", "from_frame": "data"}
_VERBS |= {"quantify": "uncertainty", "synthesize": "design", "run": "study"}  # and `identify`, which can be called

__all__ = ["__version__", *_SUBPACKAGES, *_VERBS]


def __getattr__(name: str) -> Any:
    """Load a subpackage or a function, or look up the version, on first use (PEP 562)."""
    if name in _SUBPACKAGES:
        return import_module(f"{__name__}.{name}")
    if name in _VERBS:
        return getattr(import_module(f"{__name__}.{_VERBS[name]}"), name)
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    raise AttributeError(
        f"Asked for kros.{name}; there are the functions identify, {', '.join(_VERBS)}, and the packages "
        f"{', '.join(_SUBPACKAGES)}."
    )


def __dir__() -> list[str]:
    """Names a user may ask for, loaded or not."""
    return sorted(__all__)
