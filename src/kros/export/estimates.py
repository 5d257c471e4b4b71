"""Estimates of a run as a table, CSV or Parquet, written block by block."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..core import Array, Bits, Record, write_json
from ..core.files import draft_beside
from ..data import EpisodeKey
from ..observer import SampleStatus

Write = Callable[[EpisodeKey, int, Bits, Array], None]
ENDINGS = (".parquet", ".csv")


@contextmanager
def writer(out: Path, period_s: float, facts: Record) -> Iterator[Write]:
    """Give a function that writes an episode from a sample on; the file appears whole or not at all.

    Names of CSV columns have the unit of measure in brackets.
    """
    import pyarrow as pa
    from pyarrow import csv, parquet

    text = out.suffix == ".csv"
    columns: list[Any] = [(name, pa.string()) for name in ("unit", "condition", "episode")]
    columns += [("k", pa.int64()), ("time_s", pa.float64()), ("status", pa.string())]
    for name, unit in facts["columns"].items():
        shown = f"{name} [{unit}]" if text and unit else name
        columns.append(pa.field(shown, pa.float64(), metadata={"unit": unit} if unit else None))
    about = {n: v if isinstance(v, str) else json.dumps(v) for n, v in facts.items() if v is not None}
    schema = pa.schema(columns, metadata=about)
    with draft_beside(out.absolute().parent) as draft:
        with (
            csv.CSVWriter(draft, schema)
            if text
            else parquet.ParquetWriter(draft, schema, write_page_checksum=True) as file
        ):

            def write(key: EpisodeKey, start: int, status: Bits, values: Array) -> None:
                k, bits = np.arange(start, start + len(values)), [SampleStatus(int(one)).name for one in status]
                labels = [[name] * len(k) for name in (key.unit, key.condition, key.episode)]
                columns = (pa.array(column, from_pandas=True) for column in values.T)  # empty where there is no number
                content = dict(zip(schema.names, [*labels, k, k * period_s, bits, *columns], strict=True))
                file.write_table(pa.Table.from_pydict(content, schema=schema), max(len(k), 1))

            yield write
        if text:
            write_json(out.with_name(f"{out.name}-metadata.json"), facts)
        draft.replace(out)
