"""The command line: a thin face of `kros.study`.

Exit codes: 0 done; 1 failed; 2 wrong usage or bad input, and then nothing was written; 3 done, but a requirement is not met;
4 `kros check` cannot decide on a unit; 128 and the number of a signal that told it to stop, 143 for SIGTERM. Errors become messages in `kros.edge`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from .core.errors import ConfigError
from .core.memory import keep_freed_memory
from .edge import NOT_MET, UNDECIDED, EdgeGroup, log_to_stderr

app = typer.Typer(
    name="kros",
    cls=EdgeGroup,
    help="From recordings of a batch of machines to one robust observer for all of them.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # markup would take [data] for a colour
)

Quiet = Annotated[bool, typer.Option("--json", help="Print metrics.json and nothing else on standard output.")]
Workers = Annotated[int | None, typer.Option(help="Processes for maps over units; default: one a core.")]
Scheduler = Annotated[str | None, typer.Option(help="Address of a Dask scheduler to use instead of processes.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the study.")]
Seed = Annotated[int, typer.Option(min=0)]


def _count(workers: int | None) -> int:
    from .study.engine.executors import available_cores

    return available_cores() if workers is None else workers


def _say(text: str, quiet: bool = False) -> None:
    if not quiet:
        typer.echo(text)


def _version(asked: bool) -> None:
    if asked:
        from . import __version__

        typer.echo(f"kros {__version__}")
        raise typer.Exit


@app.callback()
def main(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens to standard error.")] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error in place of a message.")
    ] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version and nothing else.")
    ] = False,
) -> None:
    """Set up logging and memory."""
    log_to_stderr(verbose)
    keep_freed_memory()


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of CSV or Parquet files.")],
    measured: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="State that is available at run time; may be given several times."),
    ] = None,
    input_: Annotated[
        list[str] | None, typer.Option("--input", metavar="NAME", help="Input; may be given several times.")
    ] = None,
    out: Annotated[Path, typer.Option(help="New study file.")] = Path("study.toml"),
    files: Annotated[
        str | None, typer.Option(metavar="REGEX", help="What a file is, in place of what its name seems to say.")
    ] = None,
    period: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Sampling period, where no column holds time.")
    ] = None,
) -> None:
    """Look at a folder of recordings and write a study for it."""
    from .data.discovery.discover import Wanted
    from .study.commands.init import init_study
    from .study.engine.progress import make_progress

    wanted = Wanted(tuple(measured or ()), tuple(input_ or ()), files, period)
    asked = _ask_parts if _on_terminal() else None
    with make_progress(False, asks=asked is not None) as progress:
        found = init_study(folder, out, wanted, asked, progress)
    for line in found.lines:
        typer.echo(line)


def _on_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def _ask_parts(columns: Any) -> Any:
    """Ask which columns are measured and which are inputs; Return takes what is proposed."""
    from .data.discovery.discover import assign
    from .data.discovery.roles import ColumnPart
    from .study.commands.init import column_lines

    for line in column_lines(columns):
        typer.echo(line)
    answers = []
    for part, what in ((ColumnPart.MEASURED, "Measured states"), (ColumnPart.INPUT, "Inputs")):
        proposed = ", ".join(c.name for c in columns if c.part is part)
        answers.append([n for n in typer.prompt(what, default=proposed).replace(",", " ").split() if n])
    return assign(columns, *answers)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Run folder: new, empty, or that of an earlier demo.")] = Path("runs/demo"),
    units: Annotated[int, typer.Option(min=2)] = 12,
    episodes: Annotated[int, typer.Option(min=2, max=1000)] = 10,
    seconds: Annotated[float, typer.Option(min=5)] = 20.0,
    seed: Seed = 0,
    set_: Overrides = None,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a population with one badly assembled drive and run the whole study on it."""
    from .study.commands.demo import run_demo
    from .study.engine.progress import make_progress

    with make_progress(quiet) as progress:
        result = run_demo(out, units, episodes, seconds, seed, _count(workers), progress, set_ or ())
    _finish(result, quiet)


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the recordings.")],
    plant: Annotated[str, typer.Option(help="harmonic-drive, pendulum or dc-motor.")] = "harmonic-drive",
    units: Annotated[int, typer.Option(min=1)] = 12,
    episodes: Annotated[int, typer.Option(min=1, max=1000)] = 10,
    seconds: Annotated[float, typer.Option(min=5)] = 20.0,
    seed: Seed = 0,
    spread: Annotated[
        float, typer.Option(min=0, help="Manufacturing spread; 1 means 5 to 15 % on every physical parameter.")
    ] = 1.0,
    loop: Annotated[str, typer.Option(help="Velocity loop: stiff or soft.")] = "stiff",
    outlier: Annotated[bool, typer.Option("--outlier", help="Add one badly assembled unit.")] = False,
    format_: Annotated[str, typer.Option("--format", help="parquet or raw, the paper's layout.")] = "parquet",
) -> None:
    """Simulate a population with known truth."""
    from .study.commands.demo import simulate_to

    simulate_to(out, plant, units, episodes, seconds, seed, spread, loop, outlier, format_)
    _say(f"recordings in {out}")


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="SRC")],
    out: Path,
    reader: Annotated[str | None, typer.Option(help="motor-drive-raw, parquet or csv; guessed by default.")] = None,
    mapping: Annotated[Path | None, typer.Option(help="TOML file that maps CSV columns to channels.")] = None,
    workers: Workers = None,
) -> None:
    """Convert any supported recording to Parquet."""
    from .study.commands.convert import convert_recordings
    from .study.engine.progress import make_progress

    with make_progress(False) as progress:
        population = convert_recordings(source, out, reader, mapping, _count(workers), progress)
    _say(f"{len(population.episodes)} episodes of {len(population.units)} units in {out}")


@app.command()
def run(
    study: Annotated[Path, typer.Argument(metavar="STUDY.toml")],
    out: Annotated[Path | None, typer.Option(help="Run folder; default: runs/<study> beside the study file.")] = None,
    until: Annotated[
        str,
        typer.Option(help="Last stage: read, calibrate, identify, quantify, synthesize, evaluate, left_out or report."),
    ] = "report",
    set_: Overrides = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
) -> None:
    """Run a study: recordings to verified observer and report."""
    from .study import Stage, load_config, run_study
    from .study.engine.progress import make_progress

    with make_progress(quiet) as progress:
        if until not in [s.value for s in Stage]:
            raise ConfigError(f"--until {until!r}: stages are {', '.join(s.value for s in Stage)}.")
        config = load_config(study, set_ or ())
        folder = out if out is not None else study.parent / "runs" / study.stem
        result = run_study(config, folder, Stage(until), _count(workers), scheduler, progress)
    _finish(result, quiet)


def _finish(result: Any, quiet: bool) -> None:
    if quiet:
        typer.echo(json.dumps(result.metrics, indent=1, ensure_ascii=False))
    else:
        from .study.commands.summary import summary_lines

        for line in summary_lines(result):
            typer.echo(line)
    for violation in result.violations:
        typer.echo(f"kros: not met: {violation}", err=True)
    if result.violations:
        raise typer.Exit(NOT_MET)


@app.command()
def check(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN")],
    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="Folder in the run's own reader, or a TOML with [data].")
    ],
    workers: Workers = None,
    quiet: Annotated[bool, typer.Option("--json", help="Print scores as JSON and nothing else.")] = False,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="Write verdicts as JUnit XML.")] = None,
    same_unit: Annotated[
        bool,
        typer.Option(
            "--same-unit", help="A unit named as one of the study is that machine: compare it with the others alone."
        ),
    ] = False,
) -> None:
    """Score new units against a finished study: PASS, FAIL or UNDECIDED; exit code 0 all pass, 3 a unit fails, 4 a unit is undecided."""
    from .study.commands.check import check_units
    from .study.commands.verdict import Verdict, junit_text, require_folder, verdict_lines, worst

    if junit is not None:
        require_folder(junit)
    scores = check_units(run_folder, data, _count(workers), same_unit)
    if quiet:
        typer.echo(json.dumps(scores, indent=1, ensure_ascii=False))
    else:
        for line in verdict_lines(scores):
            typer.echo(line)
    if junit is not None:
        junit.write_text(junit_text(scores), encoding="utf-8")
    code = {Verdict.PASS: 0, Verdict.UNDECIDED: UNDECIDED, Verdict.FAIL: NOT_MET}[worst(scores)]
    if code:
        raise typer.Exit(code)


@app.command()
def estimate(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN")],
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA", help="Folder in the run's reader, or a TOML with [data]; no hidden channels needed."
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New file, .parquet or .csv")],
    parameter: Annotated[
        list[str] | None, typer.Option(metavar="UNIT.NAME=VALUE", help="A unit's lifting parameter, such as its phase.")
    ] = None,
    track: Annotated[
        str | None, typer.Option(metavar="NAME", help="Parameter that a phase-locked loop follows.")
    ] = None,
) -> None:
    """Write the deployed observer's estimates on recordings."""
    from .study.commands.estimate import estimate_recordings

    found = estimate_recordings(run_folder, data, out, parameter or (), track)
    _say(f"estimates of {found.episodes} episode{'s' * (found.episodes != 1)} in {out}")
    for line in found.lines():
        _say(f"  {line}")


export = typer.Typer(help="An observer for machines: source code.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(export, name="export")


@export.command("c")
def export_c(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the source.")],
    name: Annotated[
        str | None, typer.Option(help="Prefix of all names, a C identifier; default: the study's name.")
    ] = None,
    precision: Annotated[str, typer.Option(help="double or float")] = "double",
    observer: Annotated[str, typer.Option(help="Observer of the run; default: the one that is deployed.")] = "deployed",
    track: Annotated[
        str | None, typer.Option(metavar="NAME", help="Parameter that a phase-locked loop follows.")
    ] = None,
) -> None:
    """Write an observer as C99 source with a self-test."""
    from .study.commands.export import export_run, numerical_error

    path = export_run(run_folder, out, name, observer, precision=precision, track=track)
    _say(numerical_error(path))
    _say(f"C source in {path}; start with {path / 'README.md'}")


@export.command("fmu")
def export_fmu(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN")],
    out: Annotated[Path, typer.Argument(metavar="OUT.fmu", help="New file.")],
    fmi: Annotated[int, typer.Option(help="Version of the standard, 2 or 3")] = 2,
    name: Annotated[
        str | None, typer.Option(help="Name of the model, a C identifier; default: the study's name.")
    ] = None,
    precision: Annotated[str, typer.Option(help="double or float")] = "double",
    observer: Annotated[str, typer.Option(help="Observer of the run; default: the one that is deployed.")] = "deployed",
    track: Annotated[
        str | None, typer.Option(metavar="NAME", help="Parameter that a phase-locked loop follows.")
    ] = None,
) -> None:
    """Write an observer as a functional mock-up unit for co-simulation."""
    from .study.commands.export import export_run

    _say(f"FMU in {export_run(run_folder, out, name, observer, fmi=fmi, precision=precision, track=track)}")


@app.command()
def report(run_folder: Annotated[Path, typer.Argument(metavar="RUN")]) -> None:
    """Write the report of a run again, from the run folder only."""
    from .study.stages.report import render_run

    path = render_run(run_folder, _count(None))
    _say(f"report: {path}")


@app.command()
def figures(run_folder: Annotated[Path, typer.Argument(metavar="RUN")], out: Path) -> None:
    """Write the report's figures as PNG and PDF."""
    from .study.engine.progress import make_progress
    from .study.stages.report import write_figures

    with make_progress(False) as progress:
        names = write_figures(run_folder, out, progress)
    _say(f"{len(names)} figures in {out}")


@app.command("list")
def list_(run_folder: Annotated[Path, typer.Argument(metavar="RUN")]) -> None:
    """Say what a run holds: stages, observers by name and how well they do."""
    from .study.commands.summary import list_run

    for line in list_run(run_folder):
        typer.echo(line)


@app.command()
def doctor() -> None:
    """Tell versions, solvers and what is missing."""
    from .study.commands.doctor import diagnose

    for line in diagnose():
        typer.echo(line)
