"""The deployed observer on recordings, written as Parquet, one row group an episode."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ConfigError, DataError, IdentificationError
from ...core.files import read_toml
from ...data import EpisodeBatch, Population, read, split_episodes
from ...data.population import EpisodeKey
from ...data.survey import RecordingFacts
from ...identify import PhaseCalibration
from ...identify.calibrate import segments_of
from ...observer import Observer, run_observer
from ..config import Stage, StudyConfig, validate_config
from ..engine.run_folder import open_finished
from ..engine.store import Store
from ..stages.read import ARRAYS

log = logging.getLogger(__name__)
_BATCH = 64


def open_data(config: StudyConfig, data: Path) -> Population:
    """Open a folder with the run's own reader, or what a TOML with ``[data]`` names."""
    data = Path(data)
    section = config.data
    if data.is_file():
        raw = read_toml(data, "DATA is no folder of recordings, and")
        section = validate_config({"data": raw.get("data", {})}, data.parent, str(data)).data
    else:
        section = section.model_copy(update={"source": data})
    return read(section.source, None if section.reader == ARRAYS else section.reader, prepare=section.prepare, mapping=section.csv)


def check_channels(population: Population, observer: Observer) -> None:
    """Refuse recordings whose channels or sampling period are not those of the run."""
    expected, found = (observer.recorded, observer.inputs), (population.states, population.inputs)
    if expected != found:
        raise DataError(f"Channels: the run has states and inputs {expected}, the recordings {found}; read them the same way.")
    if not np.isclose(population.sample_period_s, observer.sample_period_s, rtol=1e-6):
        raise DataError(
            f"Sampling period: the run has {observer.sample_period_s} s, the recordings {population.sample_period_s} s; declare a resample step."
        )


def load_calibration(store: Store) -> PhaseCalibration | None:
    """Return the run's calibration, where it has one."""
    return PhaseCalibration.load(store.path("calibration")) if store.holds("calibration", "calibration.json") else None


def unit_parameters(population: Population, calibration: PhaseCalibration | None, prefer: str) -> dict[str, dict[str, float]]:
    """Return every unit's lifting parameters.

    They are calibrated on the unit's own training episodes, on the branch of the run's population; where these do not show them, the run's
    own calibration of the unit is taken.

    Parameters
    ----------
    population : Population
    calibration : PhaseCalibration or None
    prefer : str
        Condition to calibrate on, where a unit has it.

    Raises
    ------
    IdentificationError
        When a unit can be calibrated neither way.
    """
    if calibration is None:
        return {unit: {} for unit in population.unit_ids}
    training = training_keys(population)
    parameters: dict[str, dict[str, float]] = {}
    for unit in population.unit_ids:
        own = {condition: keys for (u, condition), keys in training.items() if u == unit}
        try:
            phase = calibration.calibrate(segments_of((population, own.get(prefer) or next(iter(own.values())), calibration.spec)), unit)
        except IdentificationError:
            if unit not in calibration.units:
                raise
            log.info("unit %s: its recordings do not show the phase, that of the run is taken", unit)
            phase = calibration.units[unit]
        parameters[unit] = {calibration.spec.parameter: phase.phase_rad}
    return parameters


def training_keys(population: Population) -> dict[tuple[str, str], tuple[EpisodeKey, ...]]:
    """Return the episodes that a unit is identified on: its training part, or its only episode."""
    groups = {(u, c): keys for u, c, keys in population.groups()}
    single = {group: keys for group, keys in groups.items() if len(keys) < 2}
    several = [group for group in groups if group not in single]
    chosen = replace(population, episodes=tuple(k for group in several for k in groups[group]))
    return single | {group: split.train for group, split in split_episodes(chosen).items()}


def estimate_recordings(run: Path, data: Path, out: Path) -> int:
    """Write ``unit, condition, episode, k, <channel>_hat`` for every sample; return the number of episodes."""
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.SYNTHESIZE) as (config, store):
        if not store.holds("observers", "deployed.json"):
            raise ConfigError(f"Run {run}: has no deployed observer; run the study at least until synthesize.")
        if out.exists():
            raise ConfigError(f"Output {out}: exists; name a new file.")
        observer = Observer.load(store.path("observers", "deployed.json"))
        population = open_data(config, data)
        check_channels(population, observer)
        units = unit_parameters(population, load_calibration(store), identify_on(store))
        _write(out, population, observer, units)
    return len(population.episodes)


def identify_on(store: Store) -> str:
    """Return the condition that feeds synthesis in a run."""
    return RecordingFacts.load(store.path("population")).identify_on


def _write(out: Path, population: Population, observer: Observer, units: dict[str, dict[str, float]]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    text = pa.dictionary(pa.int32(), pa.string())
    names = [f"{s}_hat" for s in observer.recorded]
    schema = pa.schema([("unit", text), ("condition", text), ("episode", text), ("k", pa.int64()), *((n, pa.float64()) for n in names)])
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.partial")
    try:
        with parquet.ParquetWriter(temporary, schema, write_page_checksum=True) as writer:
            for start in range(0, len(population.episodes), _BATCH):
                keys = population.episodes[start : start + _BATCH]
                batch = EpisodeBatch.read(population, keys, parameters=units)
                values = batch.parameters if observer.lifting.parameters else None
                estimate = run_observer(observer, batch.states[..., list(observer.measured)], batch.inputs, values)[..., : len(names)]
                for i, key in enumerate(keys):
                    table = _table(key, estimate[: batch.lengths[i], i], schema)
                    writer.write_table(table, row_group_size=len(table))
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)


def _table(key: EpisodeKey, estimate: Any, schema: Any) -> Any:
    import pyarrow as pa

    zeros = pa.array(np.zeros(len(estimate), np.int32))
    labels = [pa.DictionaryArray.from_arrays(zeros, pa.array([text])) for text in (key.unit, key.condition, key.episode)]
    columns = [pa.array(np.ascontiguousarray(column)) for column in estimate.T]
    return pa.Table.from_arrays([*labels, pa.array(np.arange(len(estimate))), *columns], schema=schema)
