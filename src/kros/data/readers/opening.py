"""Open recordings by the name of a reader, and tell which reader fits a folder."""

from collections.abc import Collection, Iterable
from pathlib import Path

from ...core import ByName, ConfigError, DataError
from ..population import Population
from ..prepare import parse_steps
from ..prepare import prepare as prepared
from ..steps import Step
from .csv_folder import CsvMapping, csv_files, read_csv_folder
from .motor_drive_raw import is_raw_layout, read_motor_drive_raw
from .parquet import INDEX, read_parquet

READERS = ("motor-drive-raw", "parquet", "csv")


def detect_reader(source: Path | str) -> str | None:
    """Return the reader that fits a folder, or None where none does."""
    source = Path(source)
    if (source / f"{INDEX}.json").is_file():
        return "parquet"
    if is_raw_layout(source):
        return "motor-drive-raw"
    return "csv" if csv_files(source) else None


def read(
    source: Path | str,
    reader: str | None = None,
    mapping: CsvMapping | ByName | Path | str | None = None,
    prepare: Iterable[Step | ByName] = (),
    *,
    optional: Collection[str] = (),
) -> Population:
    """Open a folder of recordings; episodes are read on demand.

    Parameters
    ----------
    source : Path
    reader : str, optional
        ``motor-drive-raw``, ``parquet`` or ``csv``; None: the one that fits.
    mapping : CsvMapping, mapping or Path, optional
        How CSV files map to a population: a TOML file or the table ``[data.csv]``.
    prepare : iterable of Step or mapping
        Steps, as in ``[[data.prepare]]``, after those of the reader.
    optional : collection of str
        Channels that recordings may lack, such as states that only a test bench measures; steps that need them are
        left out with them.

    Returns
    -------
    Population

    Raises
    ------
    ConfigError
        Unknown reader or option, invalid mapping or step.
    DataError
        No such folder, an empty one, or recordings that cannot be used.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=1, seconds=1.0).simulate().population
    >>> with TemporaryDirectory() as folder:
    ...     _ = kros.data.write_parquet(motors, folder)
    ...     kros.read(folder).unit_ids
    ('001', '002')
    """
    steps, source = parse_steps(prepare), Path(source)
    if reader is not None and reader not in READERS:
        raise ConfigError(f"data.reader should be one of {', '.join(READERS)}, found {reader!r}; correct it.")
    chosen = _fitting(reader, source, mapping is not None)
    if chosen == "csv" and mapping is None:
        raise ConfigError(f"Reading {source} as csv needs a mapping; give mapping=, or [data.csv] by kros init.")
    if chosen != "csv" and mapping is not None:
        problem = "a CSV mapping is given, which only the reader 'csv' uses"
        raise ConfigError(f'Reading {source} as {chosen}: {problem}; remove it or set data.reader = "csv".')
    if mapping is not None:
        population = read_csv_folder(source, mapping, optional)
    else:
        population = read_parquet(source) if chosen == "parquet" else read_motor_drive_raw(source)
    absent = set(optional) - set(population.states) - set(population.inputs)
    return prepared(population, filter(None, (step.without(absent) for step in steps)))


def _fitting(reader: str | None, source: Path, with_mapping: bool) -> str:
    """Return the reader to use, after checking that there is a folder."""
    reading = f"Reading {source}"
    if not source.exists():
        raise DataError(f"{reading}: there is no such folder; check data.source.")
    if not source.is_dir():
        raise DataError(f"{reading}: this is a file, and recordings are a folder; give the folder that holds it.")
    fits = detect_reader(source)
    chosen = "csv" if reader is None and with_mapping else reader or fits  # a mapping takes any layout
    if chosen != "csv" and fits not in (chosen, "csv", None):
        raise DataError(f'{reading} as {chosen}: these are {fits} recordings; set data.reader = "{fits}".')
    if chosen is None:
        raise DataError(f"{reading}: no reader fits, and there are no CSV files; check data.source.")
    return chosen
