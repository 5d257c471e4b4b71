"""The observer as C99 source and as a functional mock-up unit."""

from .c99.accuracy import HeldOut
from .c99.compiled import CompiledObserver, find_compiler
from .c99.numbers import LoadOutput
from .c99.write import export_c
from .fmu.write import export_fmu

__all__ = ["CompiledObserver", "HeldOut", "LoadOutput", "export_c", "export_fmu", "find_compiler"]
