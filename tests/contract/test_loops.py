"""Time loops: compiled and in NumPy, the same numbers; and what happens where they cannot be compiled."""

import logging
import os
import shutil
import stat
import subprocess
import sys
import zipfile
from functools import partial

import numpy as np
import pytest
from families import FAMILIES, INPUT_FUNCTIONS, INPUTS, STATES
from machines import MACHINES, drive, samples

from kros.core.errors import ConfigError
from kros.export import export_fmu
from kros.identify.free_run import free_run, recursion
from kros.identify.refine.segments import Segments
from kros.identify.refine.sensitivity import normal_equations
from kros.lifting import Lifting
from kros.loops import compiler, library
from kros.loops.compiler import find_compiler
from kros.observer.simulate import run_innovations, run_observer

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler on this machine")
MACHINE_COUNT = 37  # more than are side by side at once, and no multiple of a vector


@pytest.fixture(name="both")
def _both(monkeypatch):
    """What a function returns compiled and in NumPy."""

    def both(run):
        found = []
        for choice in ("compiled", "numpy"):
            monkeypatch.setenv("KROS_LOOPS", choice)
            library.cache_clear()
            assert (library() is None) == (choice == "numpy")
            found.append(run())
        return found

    yield both
    library.cache_clear()


def assert_same(found, wanted):
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(np.isfinite(ours), np.isfinite(theirs))
        size = np.abs(theirs[np.isfinite(theirs)]).max(initial=0.0)
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12 * size)


def machines_of(count=250, lost=True):
    """Faulty samples of machines that differ, shape (count, machine, ...), and their phases; perhaps no input is lost."""
    y, u = (
        np.stack(of, axis=1)
        for of in zip(*(samples(count, turns) for turns in np.linspace(0, 0.02, MACHINE_COUNT)), strict=True)
    )
    rng = np.random.default_rng(0)
    y[rng.random(y.shape) < 0.02] = np.nan
    if lost:
        # longer than inputs are held: a new start
        u[np.repeat(rng.random(u.shape[:2]) < 2e-3, 8, axis=0)[:count]] = np.nan
    else:
        y[0, ::2], y[0, 1::2], u = 0.0, np.nan, np.where(np.isfinite(u), u, 0.0)  # compiled, gaps too
        y[rng.random(y.shape) < 0.03] += 8.0
    return y, u, np.linspace(-2, 2, MACHINE_COUNT)


@needs_compiler
@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("kind", MACHINES)
def test_observers_of_all_kinds_run_alike(kind, lost, both):
    observer, (y, u, phase) = MACHINES[kind](), machines_of(lost=lost)
    own = {"phase": phase} if observer.lifting.parameters else None

    def run():
        nu, judged = run_innovations(observer, y, u, own)
        return run_observer(observer, y, u, own), nu, judged

    assert_same(*both(run))


def model_of(lifting, units, rng):
    """Models that keep the states in the middle of where all functions are defined, and the sizes of what they multiply."""
    n, p = lifting.n_states, lifting.n_lifted + len(INPUTS) + len(lifting.input_functions)
    size = np.ones(p)
    size[n : lifting.n_lifted] += np.abs(lifting.lift(np.full(len(lifting.window.names), 0.7), {"phase": 0.5})[n:])
    W = rng.uniform(-1, 1, size=(units, n, p)) * 0.02 / p / size
    W[:, range(n), range(n)] += 0.5
    W[..., lifting.n_lifted] = 0.25
    return W, size


def recorded(rng, count, batch):
    return rng.uniform(0.6, 0.9, size=(count, batch, len(STATES))), rng.uniform(
        1.2, 1.8, size=(count, batch, len(INPUTS))
    )


@needs_compiler
@pytest.mark.parametrize("family", FAMILIES)
def test_free_runs_and_sensitivities_of_all_liftings_are_alike(family, both):
    lifting = Lifting(STATES, FAMILIES[family], ("phase",), INPUTS, INPUT_FUNCTIONS)
    rng, units, per_unit, h = np.random.default_rng(2), 3, 13, lifting.history
    (W, size), n = model_of(lifting, units, rng), lifting.n_states
    x, u = recorded(rng, h + 12, units * per_unit)
    segments = Segments(
        *(np.moveaxis(a, 2, 1).reshape(len(a), -1, units, per_unit) for a in (x, u)),
        rng.random((len(x), units, per_unit)) > 0.1,
        h,
    )
    T, phase = (
        np.triu(rng.uniform(-0.1, 0.1, size=W.shape[2:] * 2)) + np.eye(len(size)),
        rng.uniform(0.2, 0.9, size=units),
    )
    T /= size[:, None]
    V = np.linalg.solve(T, W.swapaxes(1, 2)).swapaxes(1, 2)

    def run():
        normal = normal_equations(V, T, lifting, {"phase": phase}, segments, np.array([0.5, 2.0]), 3)
        AB = np.zeros((units, lifting.n_lifted, W.shape[2]))
        AB[:, :n] = W
        first, own = x[: h + 1, :units].swapaxes(0, 1), {"phase": phase}
        free = [
            free_run(*np.split(M, [lifting.n_lifted], axis=-1), lifting, own, first, u[:, :units].swapaxes(0, 1))
            for M in (AB, AB[0])
        ]
        return normal.matrix, normal.squares, normal.counts, *free

    found, wanted = both(run)
    assert all(np.isfinite(one).all() for one in wanted)
    assert_same(found, wanted)


@needs_compiler
def test_recursions_are_alike(both):
    rng = np.random.default_rng(4)
    F, driven = 0.9 * np.eye(5) + 0.02 * rng.normal(size=(5, 5)), rng.normal(size=(200, MACHINE_COUNT, 5))
    assert_same(*both(lambda: [recursion(F, np.eye(5), driven[0], driven)]))


SOURCE = "int kros_answer(void);\nint kros_answer(void) { return 42; }\n"
FLAGS = ("-fPIC", "-shared")


@needs_compiler
def test_two_processes_may_compile_at_once(tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    both = [subprocess.Popen([sys.executable, "-c", ANSWER], env=environment) for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    assert sorted(path.suffix for path in (tmp_path / "kros").iterdir()) == [".sha256", ".so"]


@needs_compiler
def test_a_home_that_cannot_be_written_is_no_obstacle(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(compiler.tempfile, "gettempdir", lambda: str(tmp_path))
    assert compiler.load(SOURCE, FLAGS).kros_answer() == 42
    folder = tmp_path / f"kros-{os.getuid()}"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert len(list(folder.iterdir())) == 2


@needs_compiler
def test_no_library_is_loaded_from_where_others_may_put_one(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "open"))
    monkeypatch.setattr(compiler.tempfile, "gettempdir", lambda: str(tmp_path))
    for folder in (tmp_path / "open" / "kros", tmp_path / f"kros-{os.getuid()}"):
        folder.mkdir(parents=True)
        folder.chmod(0o777)
    with caplog.at_level(logging.INFO, "kros"):
        assert compiler.load(SOURCE, FLAGS) is None
    assert "no folder for it" in caplog.text


def test_without_a_compiler_that_works_numpy_takes_over_and_says_so_once(tmp_path, monkeypatch, caplog):
    library.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    with caplog.at_level(logging.INFO, "kros"):
        assert library() is None
        assert library() is None
    assert len(caplog.records) == 1
    assert "no C compiler" in caplog.text
    (tmp_path / "cc").write_text("#!/bin/sh\necho 'no licence' >&2\nexit 3\n")
    (tmp_path / "cc").chmod(0o755)
    library.cache_clear()
    with caplog.at_level(logging.INFO, "kros"):
        assert library() is None
    assert "no licence" in caplog.text
    assert run_observer(drive(), *(a[:, None] for a in samples(20, faults=False))).shape == (20, 1, 3)
    library.cache_clear()


ANSWER = f"from kros.loops import compiler; assert compiler.load({SOURCE!r}, {FLAGS!r}).kros_answer() == 42"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A folder in which a library was compiled."""
    folder = tmp_path_factory.mktemp("cache")
    subprocess.run([sys.executable, "-c", ANSWER], env=os.environ | {"XDG_CACHE_HOME": str(folder)}, check=True)
    return folder


@needs_compiler
@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "checksum"])
def test_a_damaged_library_is_compiled_again(damage, cache, tmp_path, monkeypatch):
    """A library that is cut short would end the process with SIGBUS at its first call."""
    shutil.copytree(cache, tmp_path, dirs_exist_ok=True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    built, checksum = (next((tmp_path / "kros").glob(f"*.{ending}")) for ending in ("so", "sha256"))
    whole = built.read_bytes()
    if damage == "checksum":
        checksum.write_bytes(b"\xff")
    else:
        built.write_bytes({"cut": whole[: len(whole) // 2], "changed": whole[:-1] + b"x", "empty": b""}[damage])
    subprocess.run([sys.executable, "-c", ANSWER], check=True)
    assert compiler._is_whole(built)


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("sleep 100 & sleep 100", "has not ended after"),
        ("printf '\\377\\376 no' ; exit 1", "no"),
        ("while [ $# -gt 1 ]; do [ $1 = -o ] && echo text > $2; shift; done", "does not run"),
        ("true", "does not run"),
    ],
    ids=["hangs", "prints other bytes", "writes no library", "writes nothing"],
)
def test_a_compiler_that_does_not_work_is_no_obstacle(script, reason, tmp_path, monkeypatch, caplog):
    (tmp_path / "cc").write_text(f"#!/bin/sh\n{script}\n")
    (tmp_path / "cc").chmod(0o755)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(compiler, "run_tool", partial(compiler.run_tool, seconds=0.5))
    observer = drive()
    for use in (
        lambda: compiler.load(SOURCE, FLAGS),
        lambda: next(
            (
                n
                for n in zipfile.ZipFile(export_fmu(observer, tmp_path / "d.fmu", 2, "drive")).namelist()
                if "binaries" in n
            ),
            None,
        ),
    ):
        caplog.clear()
        with caplog.at_level(logging.INFO, "kros"):
            assert use() is None
        assert reason in caplog.records[-1].getMessage()
        assert len([r for r in caplog.records if r.name == caplog.records[-1].name]) == 1


def test_an_unknown_choice_is_refused(monkeypatch):
    monkeypatch.setenv("KROS_LOOPS", "fortran")
    library.cache_clear()
    with pytest.raises(ConfigError, match=r"KROS_LOOPS=fortran.*compiled, numpy"):
        library()
    library.cache_clear()
