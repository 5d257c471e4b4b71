"""The observer as C99 source and as a functional mock-up unit."""

from .c99.compiled import CompiledObserver, find_compiler
from .c99.write import export_c

__all__ = ["CompiledObserver", "export_c", "find_compiler"]
