"""The files of an exported observer: written whole, into a folder of their own."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...core.artifacts import json_bytes, with_checksum
from ...core.errors import ConfigError
from ...core.files import whole_folder, write_bytes
from ...loops.compiler import find_compiler
from ...observer import Observer
from ...observer.file import observer_content
from ..text import require_identifier
from .accuracy import Accuracy, HeldOut
from .board import OnBoard, missing_tools
from .golden import Golden
from .numbers import LoadOutput, Source

T = TypeVar("T")
log = logging.getLogger(__name__)
_TOLERANCE = {"double": 1e-9, "float": 1e-3}


def export_c(
    observer: Observer,
    out: Path | str,
    name: str = "observer",
    precision: str = "double",
    study: Mapping[str, Any] | None = None,
    track: str | None = None,
    load: LoadOutput | None = None,
    held_out: HeldOut | None = None,
    on_board: bool = False,
) -> Path:
    """Write an observer as C99 source with a self-test, a project and a description.

    The source takes measurements and inputs as they stand in the recordings that the study read, and gives estimates so: the factors by which
    the study multiplied columns, ``about.columns`` of the observer's file, are compiled in.

    Parameters
    ----------
    observer : Observer
    out : path
        A folder that does not exist, or is empty.
    name : str
        Prefix of all public names, a C identifier.
    precision : str
        ``double`` or ``float``.
    study : mapping, optional
        The resolved study, written beside the source.
    track : str, optional
        A lifting parameter that follows the machine by a phase-locked loop (`PhaseLockedLoop`).
    load : LoadOutput, optional
        Load torque and total current with their levels, as outputs of their own.
    held_out : HeldOut, optional
        Recordings on which the numerical error is measured, where there is a compiler; the manifest and the description name it.
    on_board : bool
        Whether flash, stack and instructions of a Cortex-M4F are measured, where there are its compiler and QEMU.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ConfigError
        When the name is no C identifier, the folder holds something, a lifted function has no expression in C, or the parameter cannot be followed.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from kros.export import export_c
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer
    >>> lag = Observer.open_loop("lag", Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",), 0.01)
    >>> with TemporaryDirectory() as folder:
    ...     written = export_c(lag, Path(folder) / "c", name="lag", precision="float")
    ...     print("lag_step" in (written / "lag.h").read_text())
    True
    """
    require_identifier(name)
    if precision not in _TOLERANCE:
        raise ConfigError(f"Export to C: precision should be 'double' or 'float', found {precision!r}.")
    files = c_files(observer, name, precision, track, load)
    accuracy = board = None
    if held_out is not None and find_compiler() is not None:
        accuracy = _measured("Numerical error", lambda: Accuracy.of(files, observer, held_out, track))
    if on_board and not missing_tools():
        board = _measured("Cost on a Cortex-M4F", lambda: OnBoard.of(files, name))
    if accuracy is not None or board is not None:
        files = c_files(observer, name, precision, track, load, accuracy, board)
    if study is not None:
        files["study.json"] = json_bytes(study).decode()
    with whole_folder(Path(out)) as folder:
        for file, text in files.items():
            write_bytes(folder / file, text.encode())
    return Path(out)


def _measured(what: str, measure: Callable[[], T]) -> T | None:
    """Return a measurement that needs a compiler; None where that does not work, with one line of the log."""
    try:
        return measure()
    except ConfigError as error:
        log.warning("%s: not measured: %s", what, error)
        return None


def c_files(
    observer: Observer,
    name: str,
    precision: str,
    track: str | None = None,
    load: LoadOutput | None = None,
    accuracy: Accuracy | None = None,
    board: OnBoard | None = None,
) -> dict[str, str]:
    """Return the text of every file by its name; the same observer gives the same bytes."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    for parameter in observer.lifting.parameters:
        require_identifier(parameter, "parameter")
    source, golden = (
        Source.of(observer, name, precision, track, load),
        Golden.of(observer, track, tolerance=_TOLERANCE[precision]),
    )
    context = source.context() | {"version": version("kros")}
    context["sigma_uses_parameters"] = any(
        set(f.used) & set(observer.lifting.parameters) for f in observer.lifting.formulas
    )
    tolerance, measured = _TOLERANCE[precision], [observer.lifting.states[i] for i in observer.measured]
    y_factor, u_factor, x_factor = (
        np.array([source.factors()[n] for n in names]) for names in (measured, observer.inputs, observer.recorded)
    )
    context["golden"] = {
        "y": [[_sample(v) for v in row] for row in golden.y / y_factor],
        "u": [[_sample(v) for v in row] for row in golden.u / u_factor],
        "x": [[f"{v:.17g}" for v in row] for row in golden.x_hat / x_factor],
        "status": [f"{int(s)}u" for s in golden.status],
        "last": [f"{int(s)}u" for s in golden.last_status],
        "sure": [[f"{int(bits)}u" for bits in row] for row in golden.sure],
        "passes": golden.passes,
        "tolerance": [f"{tolerance * v:.9g}" for v in golden.size / np.abs(x_factor)],
    }
    state_bytes = _state_bytes(context)
    numbers = sum(
        len(row) for key in ("model", "correction", "into", "controller", "filter_gain") for row in context[key] or ()
    )
    numbers += (
        0
        if context["tracked"] is None
        else sum(len(row) for key in ("model", "correction") for row in context["tracked"][key])
    )
    bank = context["bank"]
    begins = 0 if bank is None else sum(map(len, bank["start"])) + 3 * len(bank["forget"])
    watched = 0 if observer.monitor is None else observer.monitor.limits.size
    largest = (
        None
        if observer.seen is None
        else ", ".join(f"{v:.6g}" for v in 1.5 * observer.seen.measured / np.abs(y_factor))
    )
    context |= {
        "state_bytes": state_bytes,
        "constant_bytes": (numbers + begins + 4 * watched) * (4 if precision == "float" else 8),
        "operations": numbers
        - sum(map(len, context["filter_gain"]))
        + context["delay"] * sum(map(len, context["model"]))
        + 7 * watched,
        "largest_angle": largest,
        "tolerance": tolerance,
        "accuracy": None if accuracy is None else accuracy.content(),
        "board": None if board is None else asdict(board),
    }
    environment = Environment(
        loader=PackageLoader("kros.export.c99"), undefined=StrictUndefined, keep_trailing_newline=True
    )
    texts = {
        f"{name}.h": "observer.h",
        f"{name}.c": "observer.c",
        f"{name}_selftest.c": "selftest.c",
        "example_main.c": "example_main.c",
        "CMakeLists.txt": "CMakeLists.txt",
        "README.md": "README.md",
    }
    code = environment.get_template("observer.c.jinja").render(context)
    functions = sorted(
        set(
            re.findall(
                r"\b(?:floor|sin|cos|tan|a?(?:sin|cos|tan)h?|exp|log|sqrt|pow|atan2|fabs|fmin|fmax)f?(?=\()", code
            )
        )
    )
    context["library"] = (
        " and ".join(f"`{f}`" for f in functions) + " (link with `-lm` where it is a library of its own)"
        if functions
        else "nothing"
    )
    files = {file: environment.get_template(f"{template}.jinja").render(context) for file, template in texts.items()}
    deployed = json_bytes(with_checksum(observer_content(observer)))
    manifest = {
        "name": name,
        "precision": precision,
        "states": list(observer.recorded),
        "measured": measured,
        "inputs": list(observer.inputs),
        "parameters": list(observer.lifting.parameters),
        **({} if track is None else {"tracked": track}),
        "units_of_measure": {s["name"]: s["unit"] for s in context["signals"]},
        "sample_period_s": observer.sample_period_s,
        "state_bytes": state_bytes,
        "numerical_error": context["accuracy"],
        "cortex_m4f": context["board"],
        **(
            {"conditions": list(observer.monitor.bounds)}
            if observer.monitor is not None and observer.monitor.bounds
            else {}
        ),
        "observer": observer.name,
        "kros": version("kros"),
        "source": "sha256:" + hashlib.sha256(deployed).hexdigest(),
    }
    return files | {"manifest.json": json_bytes(manifest).decode()}


def _sample(value: float) -> str:
    return f"{value:.17g}" if np.isfinite(value) else ("ABSENT" if np.isnan(value) else "BEYOND")


def _state_bytes(context: Mapping[str, Any]) -> int:
    """Return the size of the state: doubles first, then numbers of the build's precision, then words of four bytes."""
    real = 4 if context["single"] else 8
    doubles = context["m"] + (1 + context["m"] + len(context["shift_others"]) if context["shift"] else 0)
    reals = (
        context["n"]
        + context["order"]
        + context["history"]
        + len(context["parameters"])
        + context["delay"] * context["m"]
    )
    reals += context["n"] + context["order"] + 2 if context["tracked"] else 0
    reals += 2 * context["recorded"] + context["q"] * (context["bank"]["filters"] + 1) if context["bank"] else 0
    reals += context["q"] * context["monitor"]["bands"] * 3 + 1 if context["monitor"] else 0
    words = context["m"] + sum(bool(context[name]) for name in ("delay", "monitor")) + 2
    words += 1 if context["monitor"] and context["monitor"]["conditions"] else 0
    size = 8 * doubles + real * reals + 4 * words
    align = 8 if doubles or real == 8 else 4
    return -(-size // align) * align
