"""Generated code, compiled and run from Python."""

from __future__ import annotations

import ctypes
import json
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import numpy as np

from ...core import AnyArray, Array, Bits, ByName, ConfigError, DimensionError
from ...loops.compiler import COMPILERS, compile_library, find_compiler

FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fno-math-errno", "-ffp-contract=off")
# The loop over time, compiled beside the observer: what arrives and leaves lies sample after sample.
_LOOP = """
#include "{name}.h"
void {name}_run({name}_state *s, long count, const double *y, const double *u, double *x_hat, uint32_t *status);
void {name}_run({name}_state *s, long count, const double *y, const double *u, double *x_hat, uint32_t *status)
{{
    long k;
    for (k = 0; k < count; k++) {{
        status[k] = {name}_step{wide}(s, y + k * {q}, u + k * {m}, x_hat + k * {n});
    }}
}}
"""


class CompiledObserver:
    """An exported observer, compiled into a shared library and loaded.

    Parameters
    ----------
    folder : Path
        What `export_c` wrote.
    library : Path
        Where the shared library lies.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from kros.export import CompiledObserver, export_c
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer
    >>> lag = Observer.open_loop("lag", Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",), 0.01)
    >>> with TemporaryDirectory() as folder:  # needs a C compiler
    ...     print(CompiledObserver.build(export_c(lag, Path(folder) / "c")).selftest())
    0
    """

    def __init__(self, folder: Path, library: Path) -> None:
        manifest = json.loads((folder / "manifest.json").read_text())
        self.name, self.states = manifest["name"], tuple(manifest["states"])
        self.parameters, self.state_bytes = tuple(manifest["parameters"]), int(manifest["state_bytes"])
        self._q, self._m = len(manifest["measured"]), len(manifest["inputs"])
        self._real = ctypes.c_float if manifest["precision"] == "float" else ctypes.c_double
        self._c = ctypes.CDLL(str(library))
        self._run = self._c[f"{self.name}_run"]
        self._reset = self._c[f"{self.name}_reset{_wide(manifest)}"]

    @classmethod
    def build(cls, folder: Path | str, compiler: str | None = None, flags: Sequence[str] = ()) -> Self:
        """Compile an exported folder.

        Raises
        ------
        ConfigError
            When there is no C compiler, or it refuses the source, or takes more than a minute.
        """
        folder, compiler = Path(folder), compiler or find_compiler()
        if compiler is None:
            raise ConfigError(f"Compiling {folder}: there is no C compiler, tried {', '.join(COMPILERS)}; install one.")
        manifest = json.loads((folder / "manifest.json").read_text())
        q, m, n = (len(manifest[key]) for key in ("measured", "inputs", "states"))
        name = manifest["name"]
        library, loop = folder / f"lib{name}.so", _LOOP.format(name=name, wide=_wide(manifest), q=q, m=m, n=n)
        sources = [f"-I{folder}", str(folder / f"{name}.c"), str(folder / f"{name}_selftest.c"), "-x", "c", "-"]
        try:
            compile_library([compiler, *FLAGS, *flags, *sources], library, loop)
        except (OSError, subprocess.SubprocessError) as error:
            raise ConfigError(f"Compiling {folder}: {error}; repair the compiler, or name another.") from error
        return cls(folder, library)

    def selftest(self) -> int:
        """Run the golden vectors; 0 where they agree."""
        return int(self._c[f"{self.name}_selftest"]())

    def run(
        self, y: Array, u: Array, parameters: Mapping[str, float] | None = None, machine: Bits | None = None
    ) -> tuple[Array, AnyArray]:
        """Estimate one recording, sample by sample.

        Parameters
        ----------
        y, u : ndarray, shape (n_samples, q), (n_samples, m)
        parameters : mapping of str to float, optional
        machine : ndarray, optional
            What `start` returned, to go on from; it is moved on. A new one by default.

        Returns
        -------
        x_hat : ndarray, shape (n_samples, n_recorded)
            Row k is the prediction for k + 1.
        status : ndarray of int, shape (n_samples,)
        """
        y, u = np.ascontiguousarray(y, dtype=float), np.ascontiguousarray(u, dtype=float)
        if y.ndim != 2 or u.ndim != 2 or len(y) != len(u) or (y.shape[1], u.shape[1]) != (self._q, self._m):
            raise DimensionError(
                f"Compiled observer: needs y (n, {self._q}) and u (n, {self._m}), found {y.shape} and {u.shape}."
            )
        machine = self.start(y[0], parameters) if machine is None else machine
        x_hat, status = np.empty((len(y), len(self.states))), np.empty(len(y), dtype=np.uint32)
        self._run(_at(machine), ctypes.c_long(len(y)), *(_at(array) for array in (y, u, x_hat, status)))
        return x_hat, status

    def start(self, y: Array, parameters: Mapping[str, float] | None = None) -> Bits:
        """Return the state of a machine that starts at a measurement, shape (q,), as the C source keeps it."""
        machine = np.zeros(self.state_bytes, dtype=np.uint8)
        self._c[f"{self.name}_init"](_at(machine))
        for name, value in (parameters or {}).items():
            self._c[f"{self.name}_set_{name}"](_at(machine), self._real(value))
        self._reset(_at(machine), _at(np.ascontiguousarray(y, dtype=float)))
        return machine


def _wide(manifest: ByName) -> str:
    """Return the ending of the functions that take and give doubles."""
    return "_wide" if manifest["precision"] == "float" else ""


def _at(array: AnyArray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)
