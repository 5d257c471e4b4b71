"""Time loops: what steps sample by sample, compiled where a C compiler is found.

`loops.c` holds the loops, `library` compiles it at first use and calls it with the formulas of a lifting as data. There
is one library for all liftings, models and observers, compiled once on a machine. Where there is
none, the callers go on in NumPy, which is also what tests compare with.
"""

from __future__ import annotations

from .library import Library, formulas, library

__all__ = ["Library", "formulas", "library"]
