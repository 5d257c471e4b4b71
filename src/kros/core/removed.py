"""Names, keys and values that kros no longer has: each is refused with the sentence of the changelog that says what to use instead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# A sentence, then the public names ``kros.package.name``, the keys of a study ``section.key``, and their values ``section.key=value`` that it is for.
REMOVED: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("The section [memory] of a study is called [predictor]; rename it.", ("memory",)),
    ("Noise is declared with the sensor, for example [sensor.position] noise = 1e-6; move it there.", ("synthesis.noise",)),
    ("Full weights are no longer part of kros; use structure = 'diagonal', whose set is somewhat larger.", ("uncertainty.structure=full",)),
    ("The set of worst-case synthesis, of signals or of the form, is chosen on held-out episodes; remove the key set.", ("synthesis.set",)),
)


def instead_of(place: str) -> str:
    """Return the sentence for a name, or for a key or value, whose section may be missing; empty where it was never there."""
    matches = (sentence for sentence, places in REMOVED if any(p == place or p.endswith(f".{place}") for p in places))
    return next(matches, "")


def refusing(package: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` (PEP 562) for a package, which says what replaces a name that was removed."""

    def find(name: str) -> Any:
        reason = instead_of(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}" + (f": {reason}" if reason else ""))

    return find
