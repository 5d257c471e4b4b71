"""A run's observer as C99 source, or as a functional mock-up unit."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from ...core import ConfigError, KrosError, write_json
from ...data import EpisodeBatch
from ...data.discovery.roles import identifier
from ...evaluate.sensor import as_arriving
from ...export import CompiledObserver, LoadOutput, export_c, export_fmu
from ...loops.compiler import find_compiler
from ...observer import Observer, recorded_factors, run_observer
from ..config import Stage
from ..engine.context import Context, open_finished
from ..stages.learning import open_source
from ..stages.load import TRIAL, angle_load
from .field import load_observer

LARGEST = 20_000  # samples of the recording that generated code is compared on
TOO_COARSE = 1.0  # percent of the largest estimate: generated code that differs by more is warned of

log = logging.getLogger(__name__)


def export_run(
    run: Path,
    out: Path,
    name: str | None,
    observer: str = "deployed",
    *,
    fmi: int | None = None,
    precision: str = "double",
    track: str | None = None,
) -> tuple[Path, str]:
    """Write one of a run's observers as C source, or as an FMU of a version, and say how exact the source is.

    `name` is the study's by default.
    """
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.SYNTHESIZE) as context:
        chosen, name = load_observer(context, observer), name or identifier(context.config.name)
        if fmi is not None:
            return export_fmu(chosen, out, fmi, name, precision, track), ""
        level = angle_load(context.config.estimator, chosen.sample_period_s)
        load = LoadOutput(level, current=TRIAL.current) if observer.endswith("/load") else None
        folder = export_c(chosen, out, name, precision, track, load)
        write_json(folder / "study.json", context.config.dump())
        return folder, "" if track else exactness(folder, chosen, context)


def exactness(folder: Path, observer: Observer, context: Context) -> str:
    """Return in words how far generated code is from Python on a held-out episode; refuse code that fails its test."""
    if find_compiler() is None:
        return "not compared with Python: there is no C compiler"
    compiled = CompiledObserver.build(folder)
    if sample := compiled.selftest():
        raise ConfigError(f"Export: the self-test of {folder} fails at sample {sample}; do not use it, and report it.")
    try:
        batch = held_out_episode(context)
    except KrosError as error:
        return f"not compared with Python, since the run's recordings cannot be read: {error}"
    arriving = as_arriving(batch, observer.sensor, observer.recorded[: batch.states.shape[-1]])
    y = arriving.measurements(observer.measured)
    parameters = observer.own(batch.parameters)
    wanted = run_observer(observer, y, batch.inputs, parameters)[1:, 0, : len(observer.recorded)]
    measured = observer.outputs
    of_y, of_u, of_x = (recorded_factors(observer, n) for n in (measured, observer.inputs, observer.recorded))
    values = {name: float(np.ravel(value)[0]) for name, value in parameters.items()}
    estimates, _ = compiled.run(y[:, 0] / of_y, batch.inputs[:, 0] / of_u, values)
    apart = 100 * np.abs(estimates[:-1] * of_x - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    differences = ", ".join(f"{name} {value:.1g} %" for name, value in zip(observer.recorded, apart, strict=True))
    if not (apart <= TOO_COARSE).all():
        log.warning("single precision is too coarse for this observer; export it in double precision")
    return f"differs from Python on a held-out episode by at most {differences} of the largest estimate"


def held_out_episode(context: Context) -> EpisodeBatch:
    """Return the first episode that no design knows, as far as code is compared on it."""
    calibration = context.calibration
    keys = [key for key in context.facts.test if calibration is None or key.unit in calibration.units]
    if not keys:
        raise ConfigError("no episode is held out.")
    phase = {} if calibration is None else {calibration.spec.parameter: calibration.units[keys[0].unit].phase_rad}
    return EpisodeBatch.read(open_source(context.config), keys[:1], LARGEST, {keys[0].unit: phase})
