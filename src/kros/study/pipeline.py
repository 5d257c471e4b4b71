"""A whole study in a run folder, and what it leaves behind."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core import ByName, ConfigError, Progress, Record, Work, member, write_json
from ..data import OUTLIERS, Population, Shown, detect_reader
from ..identify.presets import resolve_lifting, resolve_phase
from ..identify.survey import check_usable
from ..observer import Observer, require_measured
from ..report.facts import Facts
from ..report.unit_verdicts import Check
from ..report.verdict import judge
from .commands.check import check_units
from .config import Stage, StudyConfig, load_config, validate_config
from .engine.context import Context, StageStep, run_steps
from .engine.executors import open_executor
from .engine.store import METRICS, Store, open_run, require_own
from .metrics import collect_metrics
from .stages import evaluate, learning, left_out, report
from .stages.learning import LEARNING
from .stages.load import require_load

STEPS = (
    *LEARNING,
    StageStep(Stage.EVALUATE, evaluate.run, ("evaluate", "sensor", "load")),
    StageStep(Stage.LEFT_OUT, left_out.run, ("evaluate", "sensor"), left_out.wanted),
    StageStep(Stage.REPORT, report.run, ("name",)),
)


@dataclass(frozen=True, repr=False)
class RunResult(Shown):
    """What a run left behind.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> with TemporaryDirectory() as folder:
    ...     result = kros.run(motors, f"{folder}/run", until="identify", identify={"refine": False})
    >>> result.folder.name, result.metrics["study"]["units"]
    ('run', 2)
    """

    folder: Path
    metrics: Record

    def _summary_rows(self) -> Record:
        facts, report = Facts(self.metrics), self.folder / "report.html"
        place = {"report": report} if report.exists() else {"results": self.folder}
        if not facts.deployed:
            units = f"{facts.study['units']}, no observer has been designed yet"
            return {"units": units, "check": " ".join(facts.study.get("alerts", ())), **place}
        verdict = judge(facts)
        numbers = {n.label: f"{n.value} {n.unit} ({'; '.join(n.notes[1:] or n.notes)})" for n in verdict.numbers}
        points = {f"point {i}": f"{reason.text} {reason.action}" for i, reason in enumerate(verdict.reasons, 1)}
        return {verdict.status.value: verdict.sentence, **points, **numbers, **place}

    @property
    def observer(self) -> Observer:
        """The observer that is deployed."""
        return Observer.load(self.folder / "observers" / "deployed.json")

    def check(self, data: Path | str, workers: int = 1, same_unit: bool = False) -> Check:
        """Return the scores of new units against the study with verdicts, as ``kros check``.

        Parameters
        ----------
        data : Path or str
            Recordings like those of the study, or a TOML file with ``[data]``.
        workers : int
        same_unit : bool
            Whether a unit of a name that the study has is the same machine, which is compared with the others alone.
        """
        return Check(check_units(self.folder, Path(data), workers, same_unit))


def run(
    source: Population | StudyConfig | Path | str,
    out: Path | str,
    *,
    until: Stage | str = Stage.REPORT,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
    **sections: Any,
) -> RunResult:
    """Run a whole study into a folder, as ``kros run``.

    Parameters
    ----------
    source : Population, Path or StudyConfig
        Recordings as `kros.read` and `kros.from_arrays` return them, a folder of them, or a study: a TOML file or what
        `load_config` returns.
    out : Path or str
        Run folder; a stage whose result is there is skipped.
    until : Stage or str
        Last stage to run.
    workers : int
        Processes for maps over units. More than one needs the usual ``if __name__ == "__main__":`` guard in a script.
    scheduler : str, optional
        Address of a Dask scheduler, instead of processes; `out` and the recordings are in a shared folder then.
    progress : Progress, optional
        Told which stage runs and how far it is.
    **sections
        Tables of a study that replace keys of the study, for example ``identify={"alpha": 90}``; ``lifting`` may be a
        list of functions.

    Returns
    -------
    RunResult

    Raises
    ------
    KrosError
        Bad input leaves no folder behind that was not there before; so does a folder of another study, or one in which
        another run is at work.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import kros
    >>> drives = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> with TemporaryDirectory() as folder:
    ...     result = kros.run(drives, folder + "/run", until="identify", identify={"refine": False})
    ...     result.metrics["study"]["units"]
    2
    """
    until, given = member(Stage, until, "--until"), source if isinstance(source, Population) else None
    out = Path(out) if scheduler is None else Path(out).absolute()  # workers elsewhere have another current folder
    config = study_of(source, out, sections)
    require_own(out, config)
    require_usable(config, until, given)
    with open_run(out, config) as store, open_executor(workers, scheduler) as mapped:
        return run_in(store, config, until, Work(mapped, progress or Progress()), given)


def study_of(source: Population | StudyConfig | Path | str, out: Path, sections: ByName) -> StudyConfig:
    """Return the study of some recordings, or a study, with keys of some tables changed."""
    tables = dict(sections)
    if isinstance(source, Population):
        if set(tables.get("data", ())) & {"source", "reader"}:
            raise ConfigError("Run: data.source and data.reader name recordings, and a population is given; drop them.")
        raw: Record = {"name": out.name, "data": {"source": out / learning.ARRAYS, "reader": learning.ARRAYS}}
    elif isinstance(source, StudyConfig):
        raw = source.dump()
    elif not isinstance(source, str | Path):
        raise ConfigError(f"Run: needs a Population, a folder or a study, found {type(source).__name__}.")
    elif Path(source).is_dir():
        reader = detect_reader(Path(source))
        raw = {"name": out.name, "data": {"source": source} | ({"reader": reader} if reader else {})}
    else:
        raw = load_config(source).dump()
    if isinstance(tables.get("lifting"), list | tuple):
        tables["lifting"] = {"functions": tables["lifting"]}
    for name, table in tables.items():
        raw[name] = {**raw.get(name, {}), **table} if isinstance(table, Mapping) else table
    return validate_config(raw, Path(), str(source) if isinstance(source, str | Path) else f"for {out}")


def require_usable(config: StudyConfig, until: Stage, population: Population | None = None) -> None:
    """Refuse what can be refused from the names of recordings alone."""
    population = learning.open_source(config, population)
    single_allowed = until in (Stage.READ, Stage.CALIBRATE, Stage.IDENTIFY)
    check_usable(population, config.split.test, config.data.identify_on, single_allowed)
    reserve = learning.draw(config, population)
    population = population.select([unit for unit in population.unit_ids if unit not in reserve])
    lifting = resolve_lifting(config.lifting, config.calibrate, population, config.split.test)
    resolve_phase(config.calibrate, population, lifting)
    require_measured(config.sensor, population.measured)
    config.estimator.require_states(population.states)
    require_load(config.load, population)
    left_out.parted([u.id for u in population.units if u.group != OUTLIERS], config.evaluate.folds)


def run_in(store: Store, config: StudyConfig, until: Stage, work: Work, given: Population | None = None) -> RunResult:
    """Run a study in its run folder, which is open."""
    context = Context(config, store, work, given)
    run_steps(context, STEPS, until)
    metrics = collect_metrics(context, until)
    write_json(store.path(METRICS), metrics)
    store.sweep()
    return RunResult(store.folder, metrics)
