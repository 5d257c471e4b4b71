"""Recordings in files that other libraries write: found by `kros init`, read back as they were written."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kros.core.errors import DataError, MissingDependencyError
from kros.data.readers.formats import FORMATS, columns_of, values_of
from kros.plants import DcMotorPopulation
from kros.study import load_config
from kros.study.stages.learning import open_source

Array = np.ndarray
NAMES = ("position", "velocity", "current", "voltage")
FACTORS = {"position": ("deg", np.pi / 180), "velocity": ("rpm", np.pi / 30), "current": ("mA", 1e-3)}
RECORDED = {name: (*FACTORS.get(name, ("V", 1.0)),) for name in NAMES}


@pytest.fixture(scope="module")
def motors():
    return DcMotorPopulation(n_units=3, n_episodes=2, seconds=1.0, seed=3).simulate().population


def as_recorded(values: Array) -> dict[str, Array]:
    """Signals in the units of measure of a test bench."""
    return {name: values[:, i] / RECORDED[name][1] for i, name in enumerate(NAMES)}


def matlab(path: Path, time: Array, signals: dict[str, Array]) -> None:
    from scipy.io import savemat

    named = {f"{name}_{RECORDED[name][0]}": values for name, values in signals.items()}
    savemat(path, {"data": {"time": time, **named}, "note": "bench 4", "fs": 500.0})


def matlab_73(path: Path, time: Array, signals: dict[str, Array]) -> None:
    """As MATLAB writes version 7.3: HDF5 behind a block of 512 bytes, rows for columns, text as numbers."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in {"time": time, **signals}.items():
            file[f"data/{name}_{RECORDED[name][0]}" if name in RECORDED else "data/time"] = values[None, :]
        file["note"] = np.frombuffer(b"bench four", np.uint8).astype(np.uint16)[:, None]
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    content = bytearray(path.read_bytes())
    content[:128] = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    path.write_bytes(content)


def hdf5(path: Path, time: Array, signals: dict[str, Array]) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["bench/time"] = time
        for name, values in signals.items():
            file[f"bench/{name}"] = values
            file[f"bench/{name}"].attrs["units"] = RECORDED[name][0]
        file["slow/temperature"] = time[::10]
        file["slow/temperature"].attrs["units"] = "degC"


def mdf(path: Path, time: Array, signals: dict[str, Array]) -> None:
    from asammdf import MDF, Signal

    recording = MDF(version="4.10")
    slow = [Signal(np.sin(time[::10]), time[::10], name="temperature", unit="degC")]
    recording.append(slow, comment="10 Hz")
    recording.append([Signal(v, time, name=n, unit=RECORDED[n][0]) for n, v in signals.items()], comment="bench")
    recording.save(path, overwrite=True)
    recording.close()


def tdms(path: Path, time: Array, signals: dict[str, Array]) -> None:
    from nptdms import ChannelObject, TdmsWriter

    def about(name: str) -> dict[str, object]:
        return {"wf_increment": float(time[1]), "wf_start_offset": 0.0, "unit_string": RECORDED[name][0]}

    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("bench", name, v, properties=about(name)) for name, v in signals.items()])


def bag(path: Path, time: Array, signals: dict[str, Array]) -> None:
    from rosbags.typesys import Stores, get_typestore

    first = path.suffix == ".bag"
    types = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    kind, array, layout = (
        types.types[f"std_msgs/msg/{n}"] for n in ("Float64MultiArray", "Float64MultiArray", "MultiArrayLayout")
    )
    if first:
        from rosbags.rosbag1 import Writer

        writer, serialize = Writer(path), types.serialize_ros1
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer, serialize = Writer(path.with_suffix(""), version=9, storage_plugin=plugin), types.serialize_cdr
    with writer:
        connection = writer.add_connection("/motor", kind.__msgtype__, typestore=types)
        for t, row in zip(time, np.column_stack(list(signals.values())), strict=True):
            stamp = 1_700_000_000_000_000_000 + round(1e9 * t)
            writer.write(connection, stamp, serialize(array(layout([], 0), row), kind.__msgtype__))


def pandas(path: Path, time: Array, signals: dict[str, Array]) -> None:
    """A frame with its time as an index without a name, a text, and a gap in a column of no interest."""
    import pandas as pd

    frame = pd.DataFrame({f"{name}_{RECORDED[name][0]}": values for name, values in signals.items()})
    frame = frame.rename(columns={"voltage_V": "voltage [V]"}).assign(
        note="bench 4", shift=pd.array([1, None] * 375)[: len(time)]
    )
    frame.index = pd.Timestamp("2026-01-01") + pd.to_timedelta(time, unit="s")
    frame.to_parquet(path)


def arrow(path: Path, time: Array, signals: dict[str, Array]) -> None:
    import pyarrow as pa
    from pyarrow import feather

    fields = [pa.field(name, pa.float64(), metadata={"unit": RECORDED[name][0]}) for name in signals]
    table = pa.table([time, *signals.values()], schema=pa.schema([pa.field("time", pa.float64()), *fields]))
    feather.write_feather(table, path)


WRITERS: dict[str, Callable[[Path, Array, dict[str, Array]], None]] = {
    ".mat": matlab,
    ".mat73": matlab_73,
    ".parquet": pandas,
    ".feather": arrow,
    ".h5": hdf5,
    ".mf4": mdf,
    ".tdms": tdms,
    ".bag": bag,
    ".mcap": bag,
    ".db3": bag,
}
PACKAGES = {".parquet": "pandas", ".mat73": "h5py", ".h5": "h5py", ".mf4": "asammdf", ".tdms": "nptdms"}


def written(folder: Path, motors, ending: str, count: int | None = None) -> Path:
    pytest.importorskip("rosbags" if WRITERS[ending] is bag else PACKAGES.get(ending, "pyarrow"))
    folder.mkdir()
    for key in motors.episodes[:count]:
        values = motors.read(key)
        path = folder / f"motor{int(key.unit)}_run{int(key.episode) + 1}{ending.removesuffix('73')}"
        WRITERS[ending](path, motors.sample_period_s * np.arange(len(values)), as_recorded(values))
    return folder


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")  # of the packages
@pytest.mark.parametrize("ending", WRITERS)
def test_files_of_a_library_are_found_and_read_in_si(kros, tmp_path, motors, ending):
    folder, study = written(tmp_path / "recordings", motors, ending), tmp_path / "study.toml"
    ros = ending in (".bag", ".mcap", ".db3")  # messages without names and units of measure
    columns = [f"motor_data_{i}" for i in range(1, 5)]
    roles = ("--measured", columns[0], "--input", columns[3]) if ros else ()
    result = kros("init", folder, "--out", study, *roles)
    assert result.exit_code == 0, result.output
    found = open_source(load_config(study))
    assert [len(keys) for _, _, keys in found.groups()] == [2] * 3
    assert found.sample_period_s == pytest.approx(motors.sample_period_s, rel=1e-6)
    assert (len(found.measured), len(found.states), len(found.inputs)) == (1, 3, 1)
    order = [next(i for i, n in enumerate(NAMES) if n in c.name or f"data_{i + 1}" in c.name) for c in found.channels]
    factors = [RECORDED[NAMES[i]][1] for i in order] if ros else np.ones(4)
    units = ["rad", "rad/s", "A", "V"]
    assert [c.unit for c in found.channels] == [units[i] if not ros else "" for i in order]
    for ours, theirs in zip(found.episodes, motors.episodes, strict=True):
        np.testing.assert_allclose(found.read(ours) * factors, motors.read(theirs)[:, order], rtol=1e-12, atol=1e-14)
    assert kros("run", study, "--out", tmp_path / "run", "--until", "read").exit_code == 0


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
@pytest.mark.parametrize("ending", WRITERS)
def test_damaged_files_are_named(tmp_path, motors, ending, capfd):
    folder = written(tmp_path / "recordings", motors, ending, 1)
    path = next(p for p in sorted(folder.rglob("*")) if p.suffix in FORMATS)
    content = path.read_bytes()
    for damaged in (b"", content[: len(content) // 2], content[:-20]):
        path.write_bytes(damaged)
        try:
            values_of(path, list(columns_of(path)))
        except DataError as error:
            assert str(path) in str(error)  # noqa: PT017
    assert "Traceback" not in capfd.readouterr().err
    path.write_bytes(b"garbage" * 100)
    with pytest.raises(DataError, match=rf"Reading .*{path.name}"):
        columns_of(path)


@pytest.mark.parametrize(
    ("ending", "extra"), [("h5", "hdf5"), ("mf4", "mdf"), ("tdms", "tdms"), ("mcap", "rosbags"), ("bag", "rosbags")]
)
def test_a_missing_package_is_named(tmp_path, monkeypatch, ending, extra):
    for name in ("h5py", "asammdf", "nptdms", "rosbags", "rosbags.highlevel"):
        monkeypatch.setitem(sys.modules, name, None)
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"anything")
    with pytest.raises(MissingDependencyError, match=rf"a\.{ending}: .*; pip install 'kros\[{extra}\]'"):
        columns_of(path)


def test_channels_of_two_time_bases_are_refused(tmp_path, motors):
    folder = written(tmp_path / "recordings", motors, ".h5", 1)
    path = next(folder.glob("*.h5"))
    assert "bench.position" in columns_of(path)
    assert list(columns_of(path, ["slow.temperature"])) == ["slow.temperature"]
    with pytest.raises(DataError, match=r"bench\.time and slow\.temperature have different time bases"):
        columns_of(path, ["bench.time", "slow.temperature", None, 3])


@pytest.mark.parametrize("ending", ["csv", "parquet"])
@pytest.mark.parametrize("several", [False, True], ids=["one file", "a file a unit"])
def test_columns_that_say_unit_and_episode_are_found(kros, tmp_path, motors, ending, several):
    import pandas as pd

    frames, folder, study = {}, tmp_path / "bench", tmp_path / "study.toml"
    for key in motors.episodes:
        values = motors.read(key)
        frame = pd.DataFrame(values, columns=[c.name for c in motors.channels])
        frame.insert(0, "time", motors.sample_period_s * np.arange(len(values)))
        frame.insert(0, "run", int(key.episode) + 1)
        frame.insert(0, "turbine_id" if several else "serial_number", f"SN-{key.unit}")
        frames.setdefault(key.unit if several else "all", []).append(frame)
    folder.mkdir()
    for name, parts in frames.items():
        table, path = pd.concat(parts, ignore_index=True), folder / f"motor{name}.{ending}"
        table.to_csv(path, index=False) if ending == "csv" else table.to_parquet(path)
    result = kros("init", folder, "--out", study)
    assert result.exit_code == 0, result.output
    found = open_source(load_config(study))
    assert [len(keys) for _, _, keys in found.groups()] == [2] * 3
    assert [c.name for c in found.channels] == list(NAMES)
    np.testing.assert_allclose(found.read(found.episodes[0]), motors.read(motors.episodes[0]), atol=1e-12)
    assert several or found.unit_ids == tuple(f"SN-{unit}" for unit in motors.unit_ids)
    options = ("--until", "identify", "--set", "identify.refine=false")
    assert kros("run", study, "--out", tmp_path / "run", *options).exit_code == 0
