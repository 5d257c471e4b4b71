"""The command line: a thin face of `kros.study`.

Exit codes: 0 done; 1 failed; 2 wrong usage or bad input, and then nothing was written; 3 done, but a requirement is not
met; 4 `kros check` cannot decide on a unit; 128 and the number of a signal that stopped it. See `edge`.
"""

import contextlib
import json
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperGroup

from .core import ConfigError, DataError, DimensionError, KrosError, MissingDependencyError, Progress

FAILED, BAD_INPUT, NOT_MET, UNDECIDED, SIGNALLED = 1, 2, 3, 4, 128
_CODES = {"PASS": 0, "SAFE": 0, "UNDECIDED": UNDECIDED}  # of verdicts
_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
_USAGE = [kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException"]  # perhaps typer's own
_PASSED: tuple[type[BaseException], ...] = (typer.Exit, typer.Abort, *_USAGE)
_PLACE = (PermissionError, FileExistsError, NotADirectoryError)  # of what somebody named
_BAD_INPUT = (ConfigError, DataError, DimensionError, MissingDependencyError, *_PLACE)


class EdgeGroup(TyperGroup):
    """Commands whose errors end as messages."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        with contextlib.nullcontext() if ctx.params.get("debug") else edge(ctx):
            return super().invoke(ctx)


@contextlib.contextmanager
def edge(ctx: Any) -> Iterator[None]:
    """Turn any exception into one message on standard error and an exit code; `ctx` knows which command it is."""
    try:
        with _stoppable():
            yield
    except KeyboardInterrupt as stopped:
        number = signal.Signals(stopped.args[0] if stopped.args else signal.SIGINT)
        resumes = ctx.invoked_subcommand in (None, "run", "demo")
        again = "the same command goes on where this one ended." if resumes else "nothing half done is left; run again."
        typer.echo(f"kros: stopped by {number.name if stopped.args else 'Ctrl-C'}; {again}", err=True)
        raise typer.Exit(SIGNALLED + number) from stopped
    except _PASSED:
        raise
    except BrokenPipeError:
        _silence_if_broken()
        raise typer.Exit(FAILED) from None
    except Exception as error:
        _silence_if_broken()
        typer.echo(f"kros: {message(error)}".encode(errors="backslashreplace").decode(), err=True)
        raise typer.Exit(BAD_INPUT if isinstance(error, _BAD_INPUT) else FAILED) from None  # for any cause


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """Raise KeyboardInterrupt with its number at a signal to stop, so that what is half done goes as after an error."""
    main = threading.current_thread() is threading.main_thread()
    signals = [number for number in _SIGNALS if main and signal.getsignal(number) is signal.SIG_DFL]

    def restore() -> None:
        for number in signals:
            signal.signal(number, signal.SIG_DFL)

    def stop(number: int, frame: object) -> None:
        restore()  # a second signal ends the process
        raise KeyboardInterrupt(number)

    for number in signals:
        signal.signal(number, stop)
    try:
        yield
    finally:
        restore()


class OnceHandler(logging.StreamHandler[TextIO]):
    """Writes every message in one line, and once."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self._written: set[str] = set()

    def format(self, record: logging.LogRecord) -> str:
        """Return one line."""
        text = record.getMessage()
        if record.name == "py.warnings":  # file, line, category and the line of source are of no use here
            text = re.sub(r"^.*?:\d+: (?:\w+: )?", "", text.strip().partition("\n")[0])
        return f"{record.levelname.lower()}: {' '.join(text.split())}"

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record that was not written before."""
        line = self.format(record)
        if record.levelno < logging.WARNING or line not in self._written:
            self._written.add(line)
            super().emit(record)


def log_to_stderr(verbose: bool) -> None:
    """Send log and warnings to standard error, a line each; warnings and errors alone unless `verbose`."""
    if logging.getLogger().handlers:
        return  # the log is read elsewhere
    handler = OnceHandler()
    handler.addFilter(lambda record: verbose or record.name != "kros.identify.survey")  # alerts stand behind the run
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, handlers=[handler])
    logging.captureWarnings(True)


def message(error: Exception) -> str:
    """Return what the command line says about an exception."""
    if isinstance(error, KrosError):
        return str(error)
    if isinstance(error, MemoryError):
        reason = str(error) or "no details"
        return f"Memory: there is not enough of it ({reason}); use fewer --workers, shorter episodes or fewer units."
    if isinstance(error, OSError):
        return f"Files: {error}; check the path, its permissions and the space that is left."
    return (
        f"Internal error, a defect of kros: {type(error).__name__}: {error}; run the command again as kros --debug ... "
        "for its traceback, and report it."
    )


def _silence_if_broken() -> None:
    """Write nothing more on standard output that is broken: Python would fail once more when it ends."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        with contextlib.suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())


app = typer.Typer(
    name="kros",
    cls=EdgeGroup,
    help="From recordings of a batch of machines to one robust observer for all of them.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # markup would take [data] for a colour
)
export = typer.Typer(help="Write an observer as C99 source or as an FMU.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(export, name="export")


def _option(text: str, *names: str, **rest: Any) -> Any:
    return typer.Option(*names, help=text, **rest)


def _argument(metavar: str, text: str | None = None) -> Any:
    return typer.Argument(metavar=metavar, help=text)


Names = list[str] | None
Run = Annotated[Path, _argument("RUN")]
Data = Annotated[Path, _argument("DATA", "Recordings like the study's, or a TOML file with [data].")]
Quiet = Annotated[bool, _option("Print JSON and nothing else on standard output.", "--json")]
Workers = Annotated[int | None, _option("Processes for maps over units; default: one a core.")]
Overrides = Annotated[Names, _option("Override a key of the study.", "--set", metavar="KEY=VALUE")]
Seed = Annotated[int, typer.Option(min=0)]
Seconds = Annotated[float, typer.Option(min=5)]
Prefix = Annotated[str | None, _option("Prefix of all names, a C identifier; default: that of the study.", "--name")]
Precision = Annotated[str, _option("double or float")]
ObserverName = Annotated[str, _option("Observer of the run; default: the one that is deployed.", "--observer")]
Track = Annotated[str | None, _option("Parameter that a phase-locked loop follows.", metavar="NAME")]


def _count(workers: int | None) -> int:
    from .study.engine.executors import available_cores

    return available_cores() if workers is None else workers


def _progress(quiet: bool = False) -> Progress:
    from .study.engine.executors import Lines

    return Progress() if quiet else Lines()


def _say(lines: Iterable[str]) -> None:
    typer.echo("\n".join(lines))


def _show(quiet: bool, content: Any, lines: Iterable[str]) -> None:
    _say([json.dumps(content, indent=1, ensure_ascii=False)] if quiet else lines)


def _version(asked: bool) -> None:
    if asked:
        from . import __version__

        typer.echo(f"kros {__version__}")
        raise typer.Exit


@app.callback()
def main(
    verbose: Annotated[bool, _option("Log what happens to standard error.", "--verbose", "-v")] = False,
    debug: Annotated[bool, _option("Show the traceback of an error in place of a message.", "--debug")] = False,
    version: Annotated[bool, _option("Print the version.", "--version", callback=_version, is_eager=True)] = False,
) -> None:
    """Set up logging."""
    log_to_stderr(verbose)


@app.command()
def init(
    folder: Annotated[Path, _argument("FOLDER", "Folder of recordings.")],
    measured: Annotated[Names, _option("State that is available at run time; repeatable.", metavar="NAME")] = None,
    input_: Annotated[Names, _option("Input; repeatable.", "--input", metavar="NAME")] = None,
    out: Annotated[Path, _option("New study file.")] = Path("study.toml"),
    files: Annotated[str | None, _option("What a file's name says, as an expression.", metavar="REGEX")] = None,
    period: Annotated[float | None, _option("Sampling period, where no column holds time.", metavar="SECONDS")] = None,
) -> None:
    """Look at a folder of recordings and write a study for it."""
    from .data.discovery.discover import Wanted
    from .study.commands.init import init_study

    wanted = Wanted(tuple(measured or ()), tuple(input_ or ()), files, period)
    _say(init_study(folder, out, wanted, _progress()))


@app.command()
def demo(
    out: Annotated[Path, _option("Run folder: new, empty, or that of an earlier demo.")] = Path("runs/demo"),
    units: Annotated[int, typer.Option(min=2)] = 12,
    episodes: Annotated[int, typer.Option(min=2, max=1000)] = 10,
    seconds: Seconds = 20.0,
    seed: Seed = 0,
    set_: Overrides = None,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a population with one badly assembled drive and run the whole study on it."""
    from .study.commands.demo import run_demo

    settings = {"n_units": units, "n_episodes": episodes, "seconds": seconds, "seed": seed, "outlier": True}
    _finish(run_demo(out, settings, _count(workers), _progress(quiet), set_ or ()), quiet)


@app.command()
def simulate(
    out: Annotated[Path, _argument("OUT", "New folder for the recordings.")],
    plant: Annotated[str, _option("harmonic-drive, pendulum or dc-motor.")] = "harmonic-drive",
    units: Annotated[int, typer.Option(min=1)] = 12,
    episodes: Annotated[int, typer.Option(min=1, max=1000)] = 10,
    seconds: Seconds = 20.0,
    seed: Seed = 0,
    outlier: Annotated[bool, _option("Add one badly assembled unit.", "--outlier")] = False,
    format_: Annotated[str, _option("parquet or raw, the paper's layout.", "--format")] = "parquet",
) -> None:
    """Simulate a population with known truth."""
    from .study.commands.demo import simulate_to

    settings = {"n_units": units, "n_episodes": episodes, "seconds": seconds, "seed": seed, "outlier": outlier}
    simulate_to(out, plant, format_, settings)
    _say([f"recordings in {out}"])


@app.command()
def run(
    study: Annotated[Path, _argument("STUDY.toml")],
    out: Annotated[Path | None, _option("Run folder; default: runs/<study> beside the study file.")] = None,
    until: Annotated[str, _option("Last stage, such as identify; an unknown one lists all.")] = "report",
    set_: Overrides = None,
    workers: Workers = None,
    scheduler: Annotated[str | None, _option("Address of a Dask scheduler to use instead of processes.")] = None,
    quiet: Quiet = False,
) -> None:
    """Run a study: recordings to verified observer and report."""
    from .study import load_config
    from .study import run as run_study

    config, folder, places = load_config(study, set_ or ()), out or study.parent / "runs" / study.stem, _count(workers)
    result = run_study(config, folder, until=until, workers=places, scheduler=scheduler, progress=_progress(quiet))
    _finish(result, quiet)


def _finish(result: Any, quiet: bool) -> None:
    _show(quiet, result.metrics, result.summary().splitlines()[1:])


@app.command()
def check(
    run_folder: Run,
    data: Data,
    workers: Workers = None,
    quiet: Quiet = False,
    out: Annotated[list[Path] | None, _option("Write .csv, .html, .json or .xml.", "--out", "--junit")] = None,
    same_unit: Annotated[bool, _option("Compare a unit of the study with the others alone.", "--same-unit")] = False,
) -> None:
    """Score new units against a finished study: PASS, FAIL or UNDECIDED; exit code 3 if one fails, 4 undecided."""
    from .report.unit_verdicts import file_writer, verdict_lines, worst
    from .study.commands.check import check_units

    write = file_writer(out or ())
    scores = check_units(run_folder, data, _count(workers), same_unit)
    _show(quiet, scores, verdict_lines(scores))
    write(scores)
    raise typer.Exit(_CODES.get(worst(scores), NOT_MET))


@app.command()
def loop(
    run_folder: Run,
    controller: Annotated[Path, _option("State space from estimates to inputs, JSON.", "--controller", metavar="FILE")],
    observer: ObserverName = "deployed",
    quiet: Quiet = False,
) -> None:
    """Judge a controller that uses the estimates: SAFE, NOT SAFE (exit code 3) or UNDECIDED (4), with its margin."""
    from .core.artifacts import plain
    from .study.commands.loop import judge_controller

    result = judge_controller(run_folder, controller, observer)
    _show(quiet, plain(vars(result)), result.lines())
    raise typer.Exit(_CODES.get(result.status, NOT_MET))


@app.command()
def watch(
    folder: Annotated[Path, _argument("FOLDER", "Where recordings arrive.")],
    run_folder: Run,
    out: Annotated[Path | None, _option("Folder of results; default: FOLDER-results.")] = None,
    every: Annotated[float, _option("Time between two looks; growing files wait.", metavar="S", min=0)] = 2.0,
    once: Annotated[bool, _option("End when everything that is there has a result.", "--once")] = False,
) -> None:
    """Check new recordings as they arrive: a line and a result file each, never lost over restarts."""
    from .study.commands.watch import watch as results

    for line in results(folder, run_folder, out, every, once):
        _say([line])


@app.command()
def estimate(
    run_folder: Run,
    data: Data,
    out: Annotated[Path, _argument("OUT", "New file, .parquet or .csv")],
    parameter: Annotated[Names, _option("Of a unit, as its phase; repeatable.", metavar="UNIT.NAME=VALUE")] = None,
    track: Track = None,
) -> None:
    """Write the deployed observer's estimates on recordings; no hidden channels are needed."""
    from .study.commands.estimate import estimate_recordings

    _say(estimate_recordings(run_folder, data, out, parameter or (), track))


@export.command("c")
def export_c(
    run_folder: Run,
    out: Annotated[Path, _argument("OUT", "New folder for the source.")],
    name: Prefix = None,
    precision: Precision = "double",
    observer: ObserverName = "deployed",
    track: Track = None,
) -> None:
    """Write an observer as C99 source with a self-test."""
    from .study.commands.export import export_run

    path, exactness = export_run(run_folder, out, name, observer, precision=precision, track=track)
    _say([*filter(None, [exactness]), f"C source in {path}; start with {path / 'README.md'}"])


@export.command("fmu")
def export_fmu(
    run_folder: Run,
    out: Annotated[Path, _argument("OUT.fmu", "New file.")],
    fmi: Annotated[int, _option("Version of the standard, 2 or 3")] = 2,
    name: Prefix = None,
    precision: Precision = "double",
    observer: ObserverName = "deployed",
    track: Track = None,
) -> None:
    """Write an observer as a functional mock-up unit for co-simulation."""
    from .study.commands.export import export_run

    path, _ = export_run(run_folder, out, name, observer, fmi=fmi, precision=precision, track=track)
    _say([f"FMU in {path}"])


@app.command()
def report(run_folder: Run) -> None:
    """Write the report of a run again, from the run folder only."""
    from .study.stages.report import render_run

    _say([f"report: {render_run(run_folder, _count(None))}"])


@app.command()
def figures(run_folder: Run, out: Annotated[Path, _argument("OUT")]) -> None:
    """Write the report's figures as PNG and PDF."""
    from .study.stages.report import write_figures

    _say([f"{len(write_figures(run_folder, out))} figures in {out}"])


@app.command()
def compare(run_folders: Annotated[list[Path], _argument("RUN RUN...")], quiet: Quiet = False) -> None:
    """Show in what runs differ: settings, recordings, errors, weights, certificates."""
    from .study.commands.summary import compare_runs

    _show(quiet, *compare_runs(run_folders))


@app.command("list")
def list_(run_folder: Run) -> None:
    """List the observers of a run with their errors, the best first."""
    from .study.commands.summary import list_run

    _say(list_run(run_folder))


@app.command()
def schema() -> None:
    """Print the JSON schema of study files, for editors; kros init writes it beside the study."""
    from .study.config import study_schema

    _show(True, study_schema(), [])


@app.command()
def doctor() -> None:
    """Print versions, the compiler and what is missing."""
    from .study.commands.summary import diagnose

    _say(diagnose())
