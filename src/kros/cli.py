"""The command line: a thin face of `kros.study`.

Exit codes: 0 done; 1 failed; 2 wrong usage or bad input, and then nothing was written; 3 done, but a requirement is not
met; 4 `kros check` cannot decide on a unit; 128 and the number of a signal that stopped it, 143 for SIGTERM. Errors
become messages in `kros.edge`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from .core.work import Progress
from .edge import NOT_MET, UNDECIDED, EdgeGroup, log_to_stderr

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


def _option(text: str, *names: str, metavar: str | None = None, **rest: Any) -> Any:
    """Return what an option says of itself."""
    return typer.Option(*names, metavar=metavar, help=text, **rest)


Text = str | None
Names = list[str] | None
Run = Annotated[Path, typer.Argument(metavar="RUN")]
Data = Annotated[
    Path, typer.Argument(metavar="DATA", help="Recordings in the format of the study, or a TOML file with [data].")
]
Quiet = Annotated[bool, _option("Print JSON and nothing else on standard output.", "--json")]
Workers = Annotated[int | None, _option("Processes for maps over units; default: one a core.")]
Overrides = Annotated[list[str] | None, _option("Override a key of the study.", "--set", metavar="KEY=VALUE")]
Seed = Annotated[int, typer.Option(min=0)]
Prefix = Annotated[str | None, _option("Prefix of all names, a C identifier; default: the study's name.", "--name")]
Precision = Annotated[str, _option("double or float")]
ObserverName = Annotated[str, _option("Observer of the run; default: the one that is deployed.", "--observer")]
Track = Annotated[str | None, _option("Parameter that a phase-locked loop follows.", metavar="NAME")]


def _count(workers: int | None) -> int:
    from .study.engine.executors import available_cores

    return available_cores() if workers is None else workers


def _progress(quiet: bool = False) -> Progress:
    from .study.engine.progress import Lines

    return Progress() if quiet else Lines()


def _say(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)


def _json(content: Any) -> None:
    typer.echo(json.dumps(content, indent=1, ensure_ascii=False))


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
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of CSV or Parquet files.")],
    measured: Annotated[Names, _option("State that is available at run time; repeatable.", metavar="NAME")] = None,
    input_: Annotated[Names, _option("Input; repeatable.", "--input", metavar="NAME")] = None,
    out: Annotated[Path, _option("New study file.")] = Path("study.toml"),
    files: Annotated[Text, _option("What a file is, in place of what its name seems to say.", metavar="REGEX")] = None,
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
    seconds: Annotated[float, typer.Option(min=5)] = 20.0,
    seed: Seed = 0,
    set_: Overrides = None,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a population with one badly assembled drive and run the whole study on it."""
    from .study.commands.demo import Simulation, run_demo

    simulation = Simulation(units, episodes, seconds, seed)
    _finish(run_demo(out, simulation, _count(workers), _progress(quiet), set_ or ()), quiet)


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the recordings.")],
    plant: Annotated[str, _option("harmonic-drive, pendulum or dc-motor.")] = "harmonic-drive",
    units: Annotated[int, typer.Option(min=1)] = 12,
    episodes: Annotated[int, typer.Option(min=1, max=1000)] = 10,
    seconds: Annotated[float, typer.Option(min=5)] = 20.0,
    seed: Seed = 0,
    outlier: Annotated[bool, _option("Add one badly assembled unit.", "--outlier")] = False,
    format_: Annotated[str, _option("parquet or raw, the paper's layout.", "--format")] = "parquet",
) -> None:
    """Simulate a population with known truth."""
    from .study.commands.demo import Simulation, simulate_to

    simulate_to(out, Simulation(units, episodes, seconds, seed, outlier=outlier, plant=plant, format=format_))
    _say([f"recordings in {out}"])


@app.command()
def run(
    study: Annotated[Path, typer.Argument(metavar="STUDY.toml")],
    out: Annotated[Path | None, _option("Run folder; default: runs/<study> beside the study file.")] = None,
    until: Annotated[
        str, _option("Last stage: read, calibrate, identify, quantify, synthesize, evaluate, left_out or report.")
    ] = "report",
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
    from .study.commands.summary import summary_lines

    if quiet:
        _json(result.metrics)
    else:
        _say(summary_lines(result))


@app.command()
def check(
    run_folder: Run,
    data: Data,
    workers: Workers = None,
    quiet: Quiet = False,
    junit: Annotated[Path | None, _option("Write verdicts as JUnit XML.", metavar="FILE")] = None,
    same_unit: Annotated[bool, _option("Compare a unit of the study with the others alone.", "--same-unit")] = False,
) -> None:
    """Score new units against a finished study: PASS, FAIL or UNDECIDED; exit code 3 if one fails, 4 undecided."""
    from .study.commands.check import check_units
    from .study.commands.verdict import Verdict, junit_text, require_folder, verdict_lines, worst

    if junit is not None:
        require_folder(junit)
    scores = check_units(run_folder, data, _count(workers), same_unit)
    if quiet:
        _json(scores)
    else:
        _say(verdict_lines(scores))
    if junit is not None:
        junit.write_text(junit_text(scores), encoding="utf-8")
    code = {Verdict.PASS: 0, Verdict.UNDECIDED: UNDECIDED, Verdict.FAIL: NOT_MET}[worst(scores)]
    if code:
        raise typer.Exit(code)


@app.command()
def estimate(
    run_folder: Run,
    data: Data,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New file, .parquet or .csv")],
    parameter: Annotated[
        Names, _option("Lifting parameter of a unit, as its phase.", metavar="UNIT.NAME=VALUE")
    ] = None,
    track: Track = None,
) -> None:
    """Write the deployed observer's estimates on recordings; no hidden channels are needed."""
    from .study.commands.estimate import estimate_recordings

    _say(estimate_recordings(run_folder, data, out, parameter or (), track))


@export.command("c")
def export_c(
    run_folder: Run,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the source.")],
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
    out: Annotated[Path, typer.Argument(metavar="OUT.fmu", help="New file.")],
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
def figures(run_folder: Run, out: Path) -> None:
    """Write the report's figures as PNG and PDF."""
    from .study.stages.report import write_figures

    _say([f"{len(write_figures(run_folder, out, _progress()))} figures in {out}"])


@app.command("list")
def list_(run_folder: Run) -> None:
    """List the observers of a run with their errors, the best first."""
    from .study.commands.summary import list_run

    _say(list_run(run_folder))


@app.command()
def doctor() -> None:
    """Print versions, solvers and what is missing."""
    from .study.commands.doctor import diagnose

    _say(diagnose())
