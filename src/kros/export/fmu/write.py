"""An FMU: sources, their description, and a binary for this machine where there is a compiler, in one archive."""

from __future__ import annotations

import io
import logging
import platform
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from ...core import ConfigError, Record, write_bytes
from ...loops.compiler import compile_library, find_compiler
from ...observer import Observer, recorded_channel
from ..c99.compiled import FLAGS
from ..c99.numbers import Source
from ..c99.write import c_files
from ..text import plain

log = logging.getLogger(__name__)
_KROS = uuid.UUID("4b0a3f5e-7f2c-5d0e-9a61-6b726f733939")
_FIXED = (1980, 1, 1, 0, 0, 0)  # the same bytes from the same observer


def export_fmu(
    observer: Observer,
    out: Path | str,
    fmi: int = 2,
    name: str = "observer",
    precision: str = "double",
    track: str | None = None,
) -> Path:
    """Write an observer as an FMU for co-simulation.

    Measurements, inputs and parameters are variables of their own names, estimates end in ``_hat``, all in the units of
    the recordings; ``status`` holds the bits of `SampleStatus`. A communication step of one sampling period takes one
    sample and gives the estimate for its end.

    Parameters
    ----------
    observer : Observer
    out : path
        A file that does not exist, ``NAME.fmu``.
    fmi : int
        2 or 3.
    name : str
        A C identifier.
    precision : str
        ``double`` or ``float``.
    track : str, optional
        A parameter that follows the machine, from its variable's value on; its present value is ``<parameter>_hat``.

    Raises
    ------
    ConfigError
        When the file exists or ends differently, the version or the name is none, or a lifted function has no
        expression in C.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from zipfile import ZipFile
    >>> import numpy as np
    >>> from kros.export import export_fmu
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer
    >>> lag = Observer.open_loop("lag", Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",), 0.01)
    >>> with TemporaryDirectory() as folder:
    ...     print("modelDescription.xml" in ZipFile(export_fmu(lag, Path(folder) / "lag.fmu", fmi=3)).namelist())
    True
    """
    out = Path(out)
    if fmi not in (2, 3):
        raise ConfigError(f"Export of an FMU: fmi should be 2 or 3, found {fmi!r}.")
    if out.suffix != ".fmu" or out.exists():
        raise ConfigError(f"Export of an FMU: {out} should be a new file that ends in .fmu.")
    source = Source.of(observer, name, precision, track)
    files = c_files(source)
    sources = {f"sources/{file}": files[file] for file in (f"{name}.h", f"{name}.c")}
    guid = str(uuid.uuid5(_KROS, sources[f"sources/{name}.c"] + files["manifest.json"]))
    texts = fmu_files(source, fmi, guid)
    every = {**texts, **sources, "documentation/README.md": files["README.md"]}
    packed = {file: text.encode() for file, text in every.items()}
    packed |= compiled(packed, name, fmi)
    archived = io.BytesIO()
    with zipfile.ZipFile(archived, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(packed):
            archive.writestr(zipfile.ZipInfo(file, _FIXED), packed[file], zipfile.ZIP_DEFLATED)
    write_bytes(out, archived.getvalue())
    return out


def fmu_files(source: Source, fmi: int, guid: str) -> dict[str, str]:
    """Return the files that make C source an FMU."""
    observer, name = source.observer, source.name
    names = (*observer.recorded, *observer.inputs)
    units = {c: plain(unit) for c in names if (unit := recorded_channel(observer, c).unit)}
    estimates = [*observer.recorded, *([] if source.loop is None else [source.loop.name])]
    more = {
        "version": version("kros"),
        "fmi": fmi,
        "guid": guid,
        "units": units,
        "estimates": len(estimates),
        "variables": variables(observer, units, estimates),
    }
    files = {f"sources/{name}_fmu.c": "machine.c", "modelDescription.xml": f"model{fmi}.xml"}
    if fmi == 3:
        files["sources/buildDescription.xml"] = "build.xml"
    return source.rendered("kros.export.fmu", files, more)


def variables(observer: Observer, units: Mapping[str, str], estimates: Sequence[str]) -> list[Record]:
    """Return the variables in the order of their references, measurements first."""
    bits = "1 missing measurement, 2 invalid input, 4 limit, 8 outside the certificate, 16 restarted"
    of_parameters = {name: f"{observer.parameters.get(name, 0.0):.17g}" for name in observer.lifting.parameters}
    every = [(observer.lifting.states[i], "input", "measured {}", "0.0") for i in observer.measured]
    every += [(name, "input", "input {}", "0.0") for name in observer.inputs]
    every += [(name, "parameter", "this machine's {}", start) for name, start in of_parameters.items()]
    outputs = [(name, "output", "estimate of {} at the end of the step", None) for name in estimates]
    rows = list[Record]()
    for index, (name, causality, text, start) in enumerate([*every, *outputs, ("status", "output", bits, None)]):
        shown = plain(name)
        row = {
            "name": f"{shown}_hat" if text.startswith("estimate") else shown,
            "causality": causality,
            "start": start,
            "variability": "tunable" if causality == "parameter" else "discrete",
            "description": text.format(shown),
            "kind": "bits" if text == bits else "real",
            "unit": units.get(name, ""),
            "index": index,
        }
        rows.append(row)
    return rows


def compiled(files: Mapping[str, bytes], name: str, fmi: int) -> dict[str, bytes]:
    """Return the shared library for this machine by its place in the archive, if a compiler works."""
    compiler = find_compiler()
    if compiler is None or sys.platform not in ("linux", "darwin"):
        return {}
    machine = platform.machine().lower().replace("amd64", "x86_64").replace("arm64", "aarch64")
    system, ending = ("linux", "so") if sys.platform == "linux" else ("darwin", "dylib")
    place = f"{machine}-{system}" if fmi == 3 else {"linux": "linux64", "darwin": "darwin64"}[system]
    with tempfile.TemporaryDirectory() as folder:
        for file, content in files.items():
            if file.startswith("sources/") and not file.endswith(".xml"):
                (Path(folder) / Path(file).name).write_bytes(content)
        library = Path(folder) / f"{name}_fmu.{ending}"
        sources = [str(Path(folder) / f"{part}.c") for part in (name, f"{name}_fmu")]
        try:
            compile_library([compiler, *FLAGS, *sources], library)
        except (OSError, subprocess.SubprocessError) as error:
            log.warning("Export of an FMU: the binary is left out: %s.", error)
            return {}
        return {f"binaries/{place}/{library.name}": library.read_bytes()}
