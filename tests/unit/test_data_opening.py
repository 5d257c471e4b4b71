"""Opening a folder by the name of a reader."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError
from kros.data import Channel, Role, from_arrays, prepare, read, write_parquet
from kros.data.readers.motor_drive_raw import CHANNELS, STEPS, write_raw
from kros.data.readers.opening import detect_reader

MAPPING: dict[str, Any] = {
    "files": r"(?P<unit>\w)_(?P<episode>\d)\.csv",
    "time": "t",
    "channel": [{"name": "x", "column": "x", "role": "state", "measured": True}],
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for each reader, one empty, one with nothing of use."""
    root = tmp_path_factory.mktemp("sources")
    rng = np.random.default_rng(0)
    drives = {u: {"load": [rng.standard_normal((1050, 5)) for _ in range(2)]} for u in ("000001", "000002")}
    channels = prepare(from_arrays({"a": [np.ones((2, 5))]}, CHANNELS, 1e-3), STEPS).channels
    write_raw(from_arrays(drives, channels, 1e-3), root / "motor-drive-raw")
    write_parquet(
        from_arrays({u: [rng.standard_normal((9, 1))] for u in "ab"}, (Channel("x", Role.STATE, measured=True),), 0.1),
        root / "parquet",
    )
    (root / "csv").mkdir()
    for unit in "ab":
        lines = ["t,x", *(f"{0.1 * k:.1f},{rng.standard_normal()}" for k in range(9))]
        (root / "csv" / f"{unit}_1.csv").write_text("\n".join(lines))
    (root / "empty").mkdir()
    (root / "other").mkdir()
    (root / "other" / "photo.jpg").write_text("")
    return root


@pytest.mark.parametrize("name", ["motor-drive-raw", "parquet", "csv"])
def test_the_fitting_reader_is_found_and_used(folders: Path, name: str) -> None:
    mapping = MAPPING if name == "csv" else None
    assert detect_reader(folders / name) == name
    named = read(folders / name, name, mapping=mapping)
    found = read(folders / name, None, mapping=mapping)
    assert len(named.unit_ids) == 2
    assert found.episodes == named.episodes
    assert named.read(named.episodes[0]).shape[1] == len(named.channels)


@pytest.mark.parametrize("reader", ["motor-drive-raw", "parquet", "csv", None])
def test_missing_empty_and_useless_folders(folders: Path, reader: str | None) -> None:
    mapping = MAPPING if reader == "csv" else None
    with pytest.raises(DataError, match=r"missing: there is no such folder; check data\.source"):
        read(folders / "missing", reader, mapping=mapping)
    with pytest.raises(DataError, match=r"this is a file"):
        read(folders / "other" / "photo.jpg", reader, mapping=mapping)
    problem = {"motor-drive-raw": "found no folder", "parquet": "there is no file", "csv": "no file matches"}
    for name in ("empty", "other"):
        with pytest.raises(DataError, match=problem.get(reader or "", "no reader fits")):
            read(folders / name, reader, mapping=mapping)


def test_unknown_reader_and_options(folders: Path) -> None:
    with pytest.raises(ConfigError, match="one of motor-drive-raw, parquet, csv, found 'hdf5'"):
        read(folders / "csv", "hdf5")
    with pytest.raises(ConfigError, match="needs a mapping"):
        read(folders / "csv", "csv")
    with pytest.raises(ConfigError, match="a CSV mapping is given"):
        read(folders / "parquet", "parquet", mapping=MAPPING)
    with pytest.raises(ConfigError, match=r"data\.prepare\[0\] \(step 'trim'\): from: unexpected keyword argument"):
        read(folders / "parquet", "parquet", prepare=[{"step": "trim", "from": 3}])


def test_another_reader_is_named_where_it_fits(folders: Path) -> None:
    with pytest.raises(DataError, match=r'these are parquet recordings; set data\.reader = "parquet"'):
        read(folders / "parquet", "motor-drive-raw")
    with pytest.raises(DataError, match=r"these are motor-drive-raw recordings; set data\.reader"):
        read(folders / "motor-drive-raw", "parquet")
