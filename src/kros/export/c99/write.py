"""The files of an exported observer: written whole, into a folder of their own, golden vectors among them."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...core import TINY, AnyArray, Array, Record, StateSpace, frozen, whole_folder, write_bytes
from ...core.artifacts import json_bytes, with_checksum
from ...observer import Observer, SampleStatus
from ...observer.file import observer_content
from .numbers import TOLERANCE, LoadOutput, Source

_ROUNDINGS = 16  # of operations, in those of the coefficients


def export_c(
    observer: Observer,
    out: Path | str,
    name: str = "observer",
    precision: str = "double",
    track: str | None = None,
    load: LoadOutput | None = None,
) -> Path:
    """Write an observer as C99 source with a self-test, a project and a description.

    The source takes measurements and inputs as they stand in the recordings that the study read, and gives estimates
    so: the factors by which the study multiplied columns, ``about.columns`` of the observer's file, are compiled in.

    Parameters
    ----------
    observer : Observer
    out : path
        A folder that does not exist, or is empty.
    name : str
        Prefix of all public names, a C identifier.
    precision : str
        ``double`` or ``float``.
    track : str, optional
        A lifting parameter that follows the machine by a phase-locked loop (`PhaseLockedLoop`).
    load : LoadOutput, optional
        Load torque and total current with their levels, as outputs of their own.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ConfigError
        When the name is no C identifier, the folder holds something, a lifted function has no expression in C, or the
        parameter cannot be followed.

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
    files = c_files(Source.of(observer, name, precision, track, load))
    with whole_folder(Path(out)) as folder:
        for file, text in files.items():
            write_bytes(folder / file, text.encode())
    return Path(out)


def c_files(source: Source) -> dict[str, str]:
    """Return the text of every file by its name; the same observer gives the same bytes."""
    name, more = source.name, {"version": version("kros"), **_golden(source)}
    files = source.rendered("kros.export.c99", {f"{name}.h": "observer.h"}, more)
    more["state_bytes"] = _state_bytes(files[f"{name}.h"], 4 if source.precision.type == "float" else 8)
    texts = {f"{name}.c": "observer.c", f"{name}_selftest.c": "selftest.c"}
    texts |= {file: file for file in ("example_main.c", "CMakeLists.txt", "README.md")}
    files |= source.rendered("kros.export.c99", texts, more)
    return files | {"manifest.json": json_bytes(_manifest(source, more["state_bytes"])).decode()}


def _golden(source: Source) -> Record:
    """Return the literals of golden vectors in the units of the recordings, and their tolerance."""
    observer, factors, tolerance = source.observer, source.factors(), TOLERANCE[source.precision.type]
    rounded = rounded_to_single(observer) if source.precision.type == "float" else None
    golden = Golden.of(observer, None if source.loop is None else source.loop.name, tolerance, rounded)
    signals = {
        "y": (golden.y, observer.outputs),
        "u": (golden.u, observer.inputs),
        "x": (golden.x_hat, observer.recorded),
    }
    allowed = golden.allowed / np.abs([factors[channel] for channel in observer.recorded])
    literals = {
        **{
            name: [[_sample(v) for v in row] for row in values / [factors[channel] for channel in names]]
            for name, (values, names) in signals.items()
        },
        "status": [f"{bits}u" for bits in golden.status],
        "last": [f"{bits}u" for bits in golden.last_status],
        "sure": [[f"{bits}u" for bits in of_bits] for of_bits in golden.sure],
        "passes": golden.passes,
        "tolerance": [f"{v:.9g}" for v in allowed],
    }
    return {"golden": literals, "tolerance": tolerance}


def _manifest(source: Source, state_bytes: int) -> Record:
    observer = source.observer
    deployed = json_bytes(with_checksum(observer_content(observer)))
    content = {
        "name": source.name,
        "precision": source.precision.type,
        "states": observer.recorded,
        "measured": observer.outputs,
        "inputs": observer.inputs,
        "parameters": observer.lifting.parameters,
        "units_of_measure": {s["name"]: s["unit"] for s in source.signals()},
        "sample_period_s": observer.sample_period_s,
        "state_bytes": state_bytes,
        "observer": observer.name,
        "kros": version("kros"),
        "source": "sha256:" + hashlib.sha256(deployed).hexdigest(),
    }
    return content | ({} if source.loop is None else {"tracked": source.loop.name})


def _sample(value: float) -> str:
    if np.isfinite(value):
        return f"{value:.17g}"
    return "ABSENT" if np.isnan(value) else "BEYOND"


def _state_bytes(header: str, real: int) -> int:
    """Return the size of the state that a header declares; larger numbers come before smaller ones."""
    declared = header[header.index("typedef struct {") : header.index("_state;")]
    sizes, counts = {"double": 8, "uint32_t": 4}, dict[int, int]()
    for kind, shape in re.findall(r"^    (\w+) \w+((?:\[\d+\])*);", declared, re.MULTILINE):
        size = sizes.get(kind, real)
        counts[size] = counts.get(size, 0) + math.prod(map(int, re.findall(r"\d+", shape)))
    align = max(counts)
    return -(-sum(size * count for size, count in counts.items()) // align) * align


@frozen
class Golden:
    """Samples and what becomes of them."""

    y: Array  # (n_samples, q)
    u: Array  # (n_samples, m)
    x_hat: Array  # (n_samples, n_recorded)
    status: AnyArray  # (n_samples,)
    passes: int
    last_status: AnyArray  # (n_samples,)
    # (2, n_samples): bits of `status` and `last_status` that no change of signals by the tolerance turns over
    sure: AnyArray
    allowed: Array  # (n_recorded,), differences of estimates that are rounding

    @classmethod
    def of(
        cls,
        observer: Observer,
        track: str | None = None,
        tolerance: float = 0.0,
        rounded: Observer | None = None,
    ) -> Golden:
        """Run an observer on smooth signals with a missing measurement, a lost input and a spike.

        Estimates may differ by a tolerance, and by what the same observer with rounded numbers says of rounding.
        """
        q, m = len(observer.measured), len(observer.inputs)
        seen = observer.seen
        y_size, u_size = (np.ones(q), np.ones(m)) if seen is None else (seen.measured, seen.inputs)
        count = 60
        k = np.arange(count)[:, None]
        y = y_size * 0.5 * np.sin(k / 20 + np.arange(q))
        u = u_size * 0.5 * np.sin((k + 1) / 20 + np.arange(m))
        y[count // 3 : count // 3 + 3] = np.nan
        u[count // 2] = np.inf
        if seen is not None:
            y[2 * count // 3] = 20 * y_size
        passes = 1 if observer.monitor is None else 2 + observer.monitor.settle // (count // 2)

        def run(factor: float, observer: Observer = observer) -> tuple[Array, npt.NDArray[np.uint32]]:
            running = observer.start(factor * y[0])
            if track is not None:
                running.track(track)
            samples = [*zip(factor * y, factor * u, strict=True)] * passes
            steps = [(np.asarray(running.step(*sample)), int(running.status)) for sample in samples]
            return np.array([x for x, _ in steps]), np.array([s for _, s in steps], np.uint32)

        x_hat, status = run(1.0)
        turned = (run(1 - tolerance)[1] ^ status) | (run(1 + tolerance)[1] ^ status)  # at a threshold but for rounding
        low, high = observer.runtime.sides(x_hat.shape[1])
        rounding = np.abs(run(1.0, rounded)[0] - x_hat).max(axis=0) if rounded is not None else 0.0
        near = np.maximum(tolerance * np.maximum(np.abs(x_hat).max(axis=0), TINY), _ROUNDINGS * rounding)
        turned |= np.where(
            ((x_hat <= low + near) | (x_hat >= high - near)).any(axis=1), np.uint32(SampleStatus.LIMIT), 0
        )
        sure = ~np.stack([turned[:count], turned[-count:]])
        return cls(y, u, x_hat[:count], status[:count], passes, status[-count:], sure, near)


def rounded_to_single(observer: Observer) -> Observer:
    """Return an observer whose numbers are those of single precision."""
    K, bank = observer.controller, observer.bank

    def single(values: Array) -> Array:
        return values.astype(np.float32).astype(float)

    A, B, C, D = map(single, K.matrices)
    K = StateSpace(A, B, C, D, K.dt)
    bank = None if bank is None else replace(bank, start=single(bank.start))
    return replace(observer, A=single(observer.A), B=single(observer.B), controller=K, bank=bank)
