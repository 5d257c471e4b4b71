"""Files that somebody damaged, exchanged or made up: one error that names them, in bounded time and memory."""

import json
import os
import socket
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kros.core import artifacts, limits
from kros.core.artifacts import load_artifact, pack_arrays, read_json, save_artifact, unpack_arrays
from kros.core.errors import ConfigError, DataError
from kros.core.files import read_bytes, read_toml, write_bytes
from kros.report.manifest import place


@pytest.fixture
def artifact(tmp_path: Path) -> Path:
    content, arrays = {"name": "a", "rows": [1.5, None], "deep": {"k": 1}}, {"A": np.eye(2), "n": np.array(["u", "v"])}
    save_artifact(tmp_path / "x", "model", content, arrays)
    return tmp_path / "x"


def test_what_was_saved_is_what_is_loaded(artifact: Path) -> None:
    content, arrays = load_artifact(artifact, "model")
    assert content == {"schema": 1, "kind": "model", "name": "a", "rows": [1.5, None], "deep": {"k": 1}}
    np.testing.assert_array_equal(arrays["A"], np.eye(2))
    assert arrays["n"].tolist() == ["u", "v"]


def test_layout_is_free_and_content_is_not(artifact: Path) -> None:
    path = artifact / "model.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content))
    load_artifact(artifact, "model")
    path.write_text(json.dumps({**content, "name": "b"}))
    with pytest.raises(DataError, match=r"model\.json: the content does not fit its checksum"):
        load_artifact(artifact, "model")
    del content["checksum"]
    path.write_text(json.dumps({**content, "name": "b"}))
    assert load_artifact(artifact, "model")[0]["name"] == "b"


def test_arrays_of_another_artifact_are_not_taken(artifact: Path) -> None:
    write_bytes(artifact / "arrays.npz", pack_arrays({"A": 2 * np.eye(2), "n": np.array(["u", "v"])}))
    with pytest.raises(DataError, match=r"not the file that model\.json was written with"):
        load_artifact(artifact, "model")
    (artifact / "arrays.npz").unlink()
    with pytest.raises(DataError, match=r"there is no file .*arrays\.npz"):
        load_artifact(artifact, "model")


@given(st.data())
def test_no_flipped_bit_is_believed(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("bits")
    save_artifact(folder, "m", {"value": 0.125}, {"A": np.arange(6.0).reshape(2, 3)})
    path = folder / data.draw(st.sampled_from(["m.json", "arrays.npz"]))
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    try:
        found, arrays = load_artifact(folder, "m")
    except DataError:
        return
    assert found["value"] == 0.125  # in the name of the checksum, or in white space
    np.testing.assert_array_equal(arrays["A"], np.arange(6.0).reshape(2, 3))


@pytest.mark.parametrize(
    "text",
    ["", "{", "[" * 100_000, '{"a": NaN}', '{"a": 1e999}', '{"a": -Infinity}', '{"a": ' + "9" * 5000 + "}", "\ufeff{}"],
)
def test_json_that_cannot_be_used(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(DataError, match="not valid JSON"):
        read_json(tmp_path / "x.json")


def test_archives_that_would_unpack_to_anything(tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    np.savez_compressed(path, A=np.zeros(10**6))
    with pytest.raises(DataError, match="compressed"):
        unpack_arrays(read_bytes(path, limits.MAX_ARRAYS_BYTES), path)
    about = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117)
    header = b"\x93NUMPY\x01\x00v\x00" + about + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("A.npy", header + bytes(8))
    with pytest.raises(DataError, match="not a valid archive"):
        unpack_arrays(read_bytes(path, limits.MAX_ARRAYS_BYTES), path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("A.npy", b"not an array")
    with pytest.raises(DataError, match="not a valid archive"):
        unpack_arrays(read_bytes(path, limits.MAX_ARRAYS_BYTES), path)
    np.savez(path, A=np.array([{}], dtype=object))
    with pytest.raises(DataError, match="not a valid archive"):
        unpack_arrays(read_bytes(path, limits.MAX_ARRAYS_BYTES), path)
    with path.open("wb") as file:
        file.truncate(limits.MAX_ARRAYS_BYTES + 1)  # takes no space on the disk
    with pytest.raises(DataError, match="files of up to"):
        unpack_arrays(read_bytes(path, limits.MAX_ARRAYS_BYTES), path)


def special(kind: str, path: Path) -> Path:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    return path


@pytest.mark.parametrize("kind", ["pipe", "socket", "folder", "device"])
def test_only_regular_files_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    path = special(kind, Path("x.toml"))
    with pytest.raises(ConfigError, match=f"a regular file is needed, found a .*{kind}"):
        read_toml(path, "Study")
    with pytest.raises(DataError, match="a regular file is needed"):
        read_json(path)
    with pytest.raises(DataError, match="a regular file is needed"):
        unpack_arrays(read_bytes(path, limits.MAX_ARRAYS_BYTES), path)


@pytest.mark.parametrize("name", ["nothing", "x" * 300, "a\0b"])
def test_paths_that_name_no_file(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=r"Reading .*check the path"):
        read_bytes(tmp_path / name, 10)


@pytest.mark.parametrize(
    "content",
    [
        b"a = " + b"[" * 5000,
        b"a = " + b"{b = " * 5000,
        b"a = " + b"9" * 5000,
        b"\xff\xfe",
        b"a = 1\0",
        b"a = 1\na = 2",
    ],
    ids=range(6),
)
def test_toml_that_cannot_be_used(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.toml").write_bytes(content)
    with pytest.raises(ConfigError, match=r"Study .*x\.toml: not a TOML file that can be used"):
        read_toml(tmp_path / "x.toml", "Study")


@pytest.mark.parametrize("name", ["..", ".", "a/../b", "./a", "a//b", "/a", "a/", "c:/x", "c:x", "a\0b", ""])
def test_names_that_are_not_those_of_files_inside_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is not the name of a file inside it"):
        place(tmp_path, name)


def test_what_checks_values_is_not_built_where_interrupts_arrive(monkeypatch):
    """An interrupt inside the compiled builder is lost, or becomes another error: the main thread only waits."""
    builders, original = [], artifacts.TypeAdapter

    class Adapter:
        def __class_getitem__(cls, kind):
            def build(*args, **options):
                builders.append(threading.current_thread())
                return original(*args, **options)

            return build

    monkeypatch.setattr(artifacts, "TypeAdapter", Adapter)
    artifacts._adapter.cache_clear()
    assert artifacts.united(tuple[int, float], [3, "inf"], {}) == (3, np.inf)
    artifacts._adapter.cache_clear()
    assert len(builders) == 1
    assert builders[0] is not threading.main_thread()
