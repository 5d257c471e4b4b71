"""The native format: `population.json` and one Parquet file per unit and condition, one row group an episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.artifacts import load_artifact
from ...core.errors import DataError
from ..arrow import fill
from ..population import Channel, EpisodeKey, Population, Role, Unit
from ..prepare import Recorded, assemble
from ..recording import Recording, look_up
from ..steps import Step

INDEX = "population"  # kind of the artifact, hence population.json


@dataclass(frozen=True, eq=False)
class ParquetRecordings:
    """Reads one row group at a time."""

    folder: str
    places: Mapping[EpisodeKey, tuple[str, int, int]]  # file, row group, samples
    columns: tuple[str, ...]

    def __call__(self, key: EpisodeKey) -> Recording:
        """Return one episode."""
        import pyarrow as pa
        from pyarrow import parquet

        name, group, samples = look_up(self.places, key)
        path = Path(self.folder) / name
        try:
            with parquet.ParquetFile(path, memory_map=True) as file:
                table = file.read_row_group(group, columns=list(self.columns), use_threads=False)
            values = np.empty((table.num_rows, len(self.columns)))
            for column, channel in enumerate(self.columns):
                fill(values[:, column], table.column(channel))
        except (OSError, pa.ArrowInvalid, KeyError, IndexError) as error:
            raise DataError(f"Reading {key} from {path}: {error}; convert the recordings again.") from error
        if len(values) != samples:
            raise DataError(
                f"Reading {key} from {path}: {samples} samples are expected, found {len(values)}; convert the recordings again."
            )
        return Recording(key, values)

    def restricted(self, keys: Iterable[EpisodeKey]) -> ParquetRecordings:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return replace(self, places={key: self.places[key] for key in keys})


def read_parquet(folder: Path | str, prepare: Iterable[Step] = ()) -> Population:
    """Read a population that `write_parquet` wrote.

    Parameters
    ----------
    folder : Path
        Holds `population.json`.
    prepare : iterable of Step

    Returns
    -------
    Population
        Lazy: only `population.json` is read.

    Raises
    ------
    DataError
        No population there, or one of another schema.
    """
    content, _ = load_artifact(Path(folder), INDEX)
    try:
        channels = tuple(Channel(c["name"], Role(c["role"]), c["unit"], c["measured"]) for c in content["channels"])
        units = [Unit(u["id"], u["group"], u["metadata"]) for u in content["units"]]
        places = _places(content["groups"])
        period, metadata = float(content["sample_period_s"]), content["metadata"]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"Reading {Path(folder) / 'population.json'}: not as kros writes it ({error!r}); convert the recordings again."
        ) from error
    missing = sorted({name for name, _, _ in places.values() if not (Path(folder) / name).is_file()})
    if missing:
        raise DataError(f"Reading {folder}: {len(missing)} files are missing, the first {missing[0]}; convert the recordings again.")
    recordings = ParquetRecordings(str(folder), places, tuple(c.name for c in channels))
    return assemble(Recorded(channels, units, list(places), recordings, period, metadata), prepare)


def _places(groups: Iterable[Mapping[str, Any]]) -> dict[EpisodeKey, tuple[str, int, int]]:
    return {
        EpisodeKey(g["unit"], g["condition"], episode): (g["file"], row_group, samples)
        for g in groups
        for row_group, (episode, samples) in enumerate(zip(g["episodes"], g["samples"], strict=True))
    }
