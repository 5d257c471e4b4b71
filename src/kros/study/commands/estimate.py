"""The deployed observer on recordings, its estimates written as Parquet or CSV; measured channels and inputs are enough."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, IdentificationError
from ...data import EpisodeBatch, Population
from ...data.population import EpisodeKey
from ...evaluate import as_arriving
from ...observer import Observer, run_observer, track_parameter
from ..config import Stage
from ..engine.run_folder import open_finished
from .recordings import UnitValues, check_channels, hidden_states, identify_on, load_calibration, open_data, parse_given, unit_values

Array = npt.NDArray[np.float64]
Write = Callable[[EpisodeKey, Array], None]
_BATCH = 64
ENDINGS = (".parquet", ".csv")


@dataclass(frozen=True)
class Estimated:
    """What was written: the number of episodes, and where every unit's parameters came from."""

    episodes: int
    parameters: dict[str, str]


def estimate_recordings(run: Path, data: Path, out: Path, given: Collection[str] = (), track: str | None = None) -> Estimated:
    """Write ``unit, condition, episode, k, <channel>_hat`` for every sample; with `track`, the parameter that is followed behind them.

    Parameters
    ----------
    run, data : Path
    out : Path
        Ends in ``.parquet`` or ``.csv``.
    given : collection of str
        Parameters of units, ``UNIT.NAME=VALUE``.
    track : str, optional
        Parameter that a phase-locked loop follows, for all units; it starts at what is given or calibrated, else at the nominal unit's.

    Raises
    ------
    ConfigError
        When the file exists or has another ending, or a parameter is none of the observer's.
    DataError
        When measured channels or inputs are missing.
    IdentificationError
        When a parameter is neither given, nor to be calibrated, nor tracked.
    """
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.SYNTHESIZE) as (config, store):
        if not store.holds("observers", "deployed.json"):
            raise ConfigError(f"Run {run}: has no deployed observer; run the study at least until synthesize.")
        if out.exists() or out.suffix not in ENDINGS:
            raise ConfigError(f"Output {out}: should be a new file that ends in {' or '.join(ENDINGS)}.")
        observer = Observer.load(store.path("observers", "deployed.json"))
        known = observer.lifting.parameters
        if track is not None and track not in known:
            raise ConfigError(f"--track {track}: the observer's parameters are {', '.join(known) or 'none'}.")
        population = open_data(config, data, hidden_states(observer))
        check_channels(population, observer, field_recordings=True)
        units = unit_values(population, load_calibration(store), identify_on(store), parse_given(given, population.unit_ids, known))
        names = [f"{s}_hat" for s in observer.recorded] + ([track] if track else [])
        sources = settled(units, observer, track)
        values = {u: {**observer.parameters, **own} for u, own in units.values.items()}
        with writer(out, names, sources, units_of_measure(population)) as write:
            for start in range(0, len(population.episodes), _BATCH):
                keys = population.episodes[start : start + _BATCH]
                batch = EpisodeBatch.read(population, keys, parameters=values)
                found = estimates(observer, population, batch, track)
                for i, key in enumerate(keys):
                    write(key, found[: batch.lengths[i], i])
    return Estimated(len(population.episodes), sources)


def settled(units: UnitValues, observer: Observer, track: str | None) -> dict[str, str]:
    """Return where every unit's parameters come from; refuse what is not known.

    Raises
    ------
    IdentificationError
    """
    sources = dict(units.sources)
    for unit, values in units.values.items():
        missing = [name for name in observer.lifting.parameters if name not in values and name != track]
        if missing:
            reason = units.reasons.get(unit, "it was not calibrated.")
            raise IdentificationError(
                f"Parameter {', '.join(missing)} of unit {unit}: {reason} Give it, --parameter {unit}.{missing[0]}=VALUE, or have it followed, "
                f"--track {missing[0]}."
            )
        if track is not None:
            sources[unit] = f"tracked from the {'nominal unit' if track not in values else 'value that is ' + sources[unit]}"
    return sources


def estimates(observer: Observer, population: Population, batch: EpisodeBatch, track: str | None) -> Array:
    """Return estimates of the recorded states, shape (n_samples, batch, n_recorded), and the parameter that is followed behind them."""
    measured = [population.states.index(observer.lifting.states[i]) for i in observer.measured]
    y = as_arriving(batch, observer.sensor, population.states).measurements(measured)
    u = batch.inputs[..., [population.inputs.index(name) for name in observer.inputs]]
    values, n = observer.own(batch.parameters) if observer.lifting.parameters else None, len(observer.recorded)
    if track is None:
        return run_observer(observer, y, u, values)[..., :n]
    found = track_parameter(observer, y, u, values, track)
    return np.concatenate([found.estimates[..., :n], found.values[..., None]], axis=-1)


def units_of_measure(population: Population) -> dict[str, str]:
    """Return the units of the estimates that recordings name."""
    return {f"{c.name}_hat": c.unit for c in population.channels if c.unit}


@contextmanager
def writer(out: Path, names: Collection[str], sources: dict[str, str], units: dict[str, str]) -> Iterator[Write]:
    """Give a function that writes one episode's estimates; the file appears whole or not at all."""
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.partial")
    try:
        with (_csv if out.suffix == ".csv" else _parquet)(temporary, names, sources, units) as write:
            yield write
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _csv(path: Path, names: Collection[str], sources: dict[str, str], units: dict[str, str]) -> Iterator[Write]:
    import csv

    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["unit", "condition", "episode", "k", *names])
        yield lambda key, values: rows.writerows(
            [key.unit, key.condition, key.episode, k, *(repr(v) for v in row)] for k, row in enumerate(values.tolist())
        )


@contextmanager
def _parquet(path: Path, names: Collection[str], sources: dict[str, str], units: dict[str, str]) -> Iterator[Write]:
    import pyarrow as pa
    from pyarrow import parquet

    text = pa.dictionary(pa.int32(), pa.string())
    columns = [pa.field(n, pa.float64(), metadata={"unit": units[n]} if n in units else None) for n in names]
    labels = [("unit", text), ("condition", text), ("episode", text), ("k", pa.int64())]
    schema = pa.schema([*(pa.field(*label) for label in labels), *columns], metadata={"parameters": json.dumps(sources)})
    with parquet.ParquetWriter(path, schema, write_page_checksum=True) as file:

        def write(key: EpisodeKey, values: Array) -> None:
            zeros = pa.array(np.zeros(len(values), np.int32))
            labelled = [pa.DictionaryArray.from_arrays(zeros, pa.array([t])) for t in (key.unit, key.condition, key.episode)]
            numbers = [pa.array(np.ascontiguousarray(column)) for column in values.T]
            table = pa.Table.from_arrays([*labelled, pa.array(np.arange(len(values))), *numbers], schema=schema)
            file.write_table(table, row_group_size=max(len(table), 1))

        yield write
