"""Bad input: exit code 2 (or 1 where the data are at fault only after computing), one clear message, no half-written run folder."""

import shutil
from pathlib import Path

import pytest

from kros.data import read, write_parquet


@pytest.fixture(scope="module")
def simulated(kros, tmp_path_factory) -> Path:
    """A small recording in the paper's raw layout."""
    out = tmp_path_factory.mktemp("simulated") / "raw"
    result = kros("simulate", out, "--units", 2, "--episodes", 3, "--seconds", 5, "--format", "raw")
    assert result.exit_code == 0, result.output
    return out


@pytest.fixture
def raw(simulated, tmp_path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(simulated, tmp_path / "raw"))


def refused(kros, study, tmp_path, *words, code=2, options=()):
    out = tmp_path / "out"
    result = kros("run", study, "--out", out, *options)
    assert result.exit_code == code, result.output
    messages = [line for line in result.stderr.splitlines() if line.startswith("kros: ")]
    assert len(messages) == 1, result.stderr
    for word in words:
        assert word in messages[0]
    assert code == 1 or not out.exists()
    assert "Traceback" not in result.stderr


def test_what_is_not_there(kros, study, tmp_path):
    refused(kros, study(source=tmp_path / "nowhere"), tmp_path, "nowhere")
    refused(kros, study(source="a\\u0000b"), tmp_path, "NUL")
    refused(kros, tmp_path / "no.toml", tmp_path, "no.toml")


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("[identify]\nalpha = -1", ("identify.alpha", "-1")),
        ("[load]\ninertia = nan", ("inertia",)),
        ("[[lifting.families]]\nkind = 'harmonics'\nangle = 5\nratio = []", ("lifting",)),
        ("[uncertainty]\nform = 'upside_down'", ("uncertainty.form", "upside_down")),
        ("[nonsense]\na = 1", ("nonsense", "unknown key")),
        ("[lifting]\nfunctions = ['sin(positoin)']", ("positoin", "position")),
        ("[lifting]\nfunctions = ['__import__(\"os\").abort()']", ("not allowed",)),
        ("[estimator]\nrows = 4", ("estimator", "rows", "1000")),
        ("[calibrate]\nangle = 'theta'", ("theta", "position")),
        ("[split]\ntest = ['0', '1', '2', '3']", ("split.test",)),
        ("[split]\ntest = ['0', '99']", ("split.test: no episode is named 99; there are 0, 1, 2",)),
        ("[identify]\nalpha = true", ("identify.alpha: input should not be true or false, found True",)),
        ("[estimator]\nlimits = {current = [1.0, -1.0]}", ("estimator.limits: current = [1, -1] should be the least",)),
        ("[estimator]\nlimits = {nobody = [-1.0, 1.0]}", ("estimator.limits: nobody = [-1, 1] should be",)),
        ("[load]\nmoment = 1.0\nunits = ['nobody']", ("load: there is no unit or state 'nobody' in 000000, 001001",)),
        ("[sensor.position]\nnoise = 1e300", ("at most 1e+50", "found 1e+300")),
        ("[data.csv]\nfiles = 1\n[data.x]", ("data.x",)),
        ("not toml", ("TOML",)),
        ("a = " + "[" * 5000, ("nested",)),
    ],
)
def test_bad_studies(kros, study, tmp_path, extra, words):
    refused(kros, study(extra), tmp_path, *words)


def test_a_function_that_is_not_finite_on_the_recordings(kros, study, tmp_path):
    path, out = study("[lifting]\nfunctions = ['log(velocity)']"), tmp_path / "out"
    result = kros("run", path, "--out", out, "--until", "identify")
    assert result.exit_code == 2
    assert "log(velocity) is not finite, or huge; use functions that are moderate on all recordings" in result.stderr


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--set", "data.identify_on=hot", ("hot", "noload")),
        ("--set", "identify.alpha", ("KEY=VALUE",)),
        ("--set", "identify.alpha=" + "[" * 5000, ("--set",)),
        ("--set", "identify.alpha=" + "9" * 5000, ("--set",)),
        ("--until", "lunch", ("--until", "quantify")),
    ],
)
def test_bad_options(kros, study, tmp_path, option, value, words):
    refused(kros, study(), tmp_path, *words, options=(option, value))


def test_one_unit_only(kros, study, tmp_path, raw):
    for folder in (raw / "batch_b" / "population").glob("*001002*"):
        shutil.rmtree(folder)
    path = study(source=raw, reader="motor-drive-raw")
    refused(kros, path, tmp_path, "001001")
    result = kros("run", path, "--out", tmp_path / "one", "--until", "identify")
    assert result.exit_code == 0, result.output


def test_an_existing_folder_of_something_else_is_left_alone(kros, study, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    result = kros("run", study(), "--out", out)
    assert result.exit_code == 2
    assert [p.name for p in out.iterdir()] == ["thesis.txt"]
    assert kros("demo", "--out", out).exit_code == 2
    assert kros("simulate", out).exit_code == 2
    assert [p.name for p in out.iterdir()] == ["thesis.txt"]


def test_a_model_that_no_regularisation_was_allowed_to_stabilise(kros, study, tmp_path):
    refused(kros, study(), tmp_path, "spectral radius", "alpha", code=1, options=("--set", "identify.alpha=1e-9"))


@pytest.mark.parametrize(("command", "count"), [("check", 1), ("estimate", 2), ("report", 0), ("figures", 1)])
def test_commands_on_something_that_is_not_a_run(kros, tmp_path, command, count):
    result = kros(command, *[tmp_path, tmp_path, tmp_path / "x.parquet"][: 1 + count])
    assert result.exit_code == 2
    assert "study.json" in result.stderr


def test_bad_recordings_leave_an_earlier_run_as_it_was(kros, study, tmp_path, raw):
    path, out = study(source=raw, reader="motor-drive-raw"), tmp_path / "run"
    assert kros("run", path, "--out", out, "--until", "calibrate").exit_code == 0
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    first = sorted(raw.rglob("*.csv"))[0]
    lines = first.read_text().splitlines(keepends=True)
    first.write_text("".join(lines[:2000] + lines[2010:]))
    result = kros("run", path, "--out", out, "--until", "calibrate")
    assert result.exit_code == 2
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize(("kind", "code"), [("memory", 1), ("damaged", 2)])
@pytest.mark.parametrize("reader", ["parquet", "motor-drive-raw"])
def test_out_of_memory_is_not_taken_for_a_damaged_file(kros, tmp_path, raw, monkeypatch, kind, code, reader):
    """A reader of Arrow fails alike where memory ran out and where a file states a size that it has not; the second is a fault of the file."""
    import pyarrow as pa

    def fail(*_: object, **__: object) -> None:
        raise pa.ArrowMemoryError(f"malloc of size {10**15 if kind == 'damaged' else 4096} failed")

    source = raw
    if reader == "parquet":
        source = tmp_path / "parquet"
        write_parquet(read(raw), source)
        monkeypatch.setattr("pyarrow.parquet.ParquetFile.read_row_group", fail)
    else:
        monkeypatch.setattr("pyarrow.csv.open_csv", fail)
    (tmp_path / "study.toml").write_text(f'[data]\nsource = "{source}"\nreader = "{reader}"\n')
    result = kros("run", tmp_path / "study.toml", "--out", tmp_path / "out", "--until", "read")
    assert result.exit_code == code, result.stderr
    assert result.stderr.startswith("kros: Memory: there is not enough of it" if code == 1 else "kros: Reading ")
