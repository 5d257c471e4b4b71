"""The observer as C99 source and as a functional mock-up unit.

Examples
--------
>>> from pathlib import Path
>>> from tempfile import TemporaryDirectory
>>> import numpy as np
>>> from kros.export import export_c
>>> from kros.lifting import Lifting
>>> from kros.observer import Observer
>>> plant = Observer.open_loop("lag", Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",), 0.01)
>>> with TemporaryDirectory() as folder:
...     files = sorted(path.suffix for path in export_c(plant, Path(folder) / "c").parent.rglob("*.[ch]"))
>>> ".c" in files and ".h" in files
True
"""

from .c99.compiled import CompiledObserver
from .c99.numbers import LoadOutput
from .c99.write import export_c
from .fmu.write import export_fmu

__all__ = ["CompiledObserver", "LoadOutput", "export_c", "export_fmu"]
