"""A run's observer as C99 source, or as a functional mock-up unit."""

import logging
from pathlib import Path

import numpy as np

from ...core import ConfigError, KrosError, write_json
from ...data.measures import identifier
from ...evaluate.sensor import arriving
from ...export import CompiledObserver, LoadOutput, export_c, export_fmu
from ...loops.compiler import find_compiler
from ...observer import Observer, recorded_factors, run_observer
from ..engine.context import Context, open_finished
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
    with open_finished(run) as context:
        chosen, name = load_observer(context, observer), name or identifier(context.config.name)
        if fmi is not None:
            path, compared = export_fmu(chosen, out, fmi, name, precision, track), ""
        else:
            level = angle_load(context.config.estimator, chosen.sample_period_s)
            load = LoadOutput(level, current=TRIAL.current) if observer.endswith("/load") else None
            path = export_c(chosen, out, name, precision, track, load)
            write_json(path / "study.json", context.config.dump())
            compared = "" if track else exactness(path, chosen, context)
        if precision == "float" and not compared:
            log.warning("single precision was not compared with Python: its error on this observer is not known")
        return path, compared


def exactness(folder: Path, observer: Observer, context: Context) -> str:
    """Return how far generated code is from Python on a held-out episode, if it can be run; refuse what fails its test.

    A reason why it cannot be compared is a warning.
    """
    if find_compiler() is None:
        log.warning("not compared with Python: there is no C compiler")
        return ""
    compiled = CompiledObserver.build(folder)
    if sample := compiled.selftest():
        raise ConfigError(f"Export: the self-test of {folder} fails at sample {sample}; do not use it, and report it.")
    try:
        population, parameters = context.population, context.identified.parameters
        key = next(k for k in context.facts.test if k.unit in parameters)
        arrived = arriving(observer, population, {key: population.read(key)[:LARGEST]}, parameters)
    except KrosError as error:
        log.warning("not compared with Python, since the run's recordings cannot be read: %s", error)
        return ""
    wanted = run_observer(observer, arrived.y, arrived.u, arrived.parameters)[1:, 0]
    signals = observer.outputs, observer.inputs, observer.recorded
    of_y, of_u, of_x = (recorded_factors(observer, names) for names in signals)
    values = {name: np.ravel(value).item() for name, value in arrived.parameters.items()}
    estimates, _ = compiled.run(arrived.y[:, 0] / of_y, arrived.u[:, 0] / of_u, values)
    apart = 100 * np.abs(estimates[:-1] * of_x - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    differences = ", ".join(f"{name} {value:.1g} %" for name, value in zip(observer.recorded, apart, strict=True))
    if not (apart <= TOO_COARSE).all():
        log.warning("single precision is too coarse for this observer; export it in double precision")
    return f"differs from Python on a held-out episode by at most {differences} of the largest estimate"
