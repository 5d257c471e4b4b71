"""Recordings as anybody's CSV files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from kros.data import Population

Change = Callable[[np.ndarray, int], np.ndarray]


def write_csvs(
    folder: Path,
    population: Population,
    name: str,
    header: str,
    change: Change = lambda values, _: values,
    count: int = 99,
) -> Path:
    """Write a file for each of the first episodes, with time where the header has a column more; return the folder."""
    for number, key in enumerate(population.episodes[:count]):
        values = change(population.read(key), number)
        if header.count(",") == values.shape[1]:
            values = np.column_stack([population.sample_period_s * np.arange(len(values)), values])
        path = folder / name.format(key=key)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, values, "%.17g", ",", header=header, comments="")
    return folder
