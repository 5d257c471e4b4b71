"""Generated C against the observer in Python: estimates, status bits, precision after many turns, and compilers that complain about nothing."""

import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from machines import LIMITS, MACHINES, apart, drive, filters, in_python, samples, watched

from kros.core.errors import ConfigError, DataError
from kros.export import CompiledObserver, LoadOutput, export_c
from kros.export.c99.write import Golden
from kros.lifting import Lifting
from kros.loops.compiler import find_compiler
from kros.motor_drive import AngleLoad
from kros.observer import Observer, Runtime, SampleStatus, run_observer

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror", "-pedantic")
TRAPPED = ("-fsanitize=undefined", "-fsanitize-undefined-trap-on-error", "-Wno-unused-function", "-O0")
# Machines that have everything together, in single precision too.
SINGLE = (
    "limits, delay and start",
    "every function",
    "input functions",
    "filter bank with limits",
    "monitor and delay",
)
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler is on the PATH")


@needs_compiler
@pytest.mark.parametrize("kind", MACHINES)
def test_same_estimates_and_the_same_status_under_faults(kind, tmp_path):
    observer, (y, u) = MACHINES[kind](), samples(800 if "monitor" in kind else 250)
    wanted, status = in_python(observer, y, u)
    assert len(set(status)) >= 4
    assert (status & SampleStatus.UNCERTIFIED).any() == ("monitor" in kind)
    for precision, close in (("double", 1e-9), ("float", 1e-4))[: 1 + (kind in SINGLE)]:
        folder = export_c(observer, tmp_path / precision, "drive", precision)
        compiled = CompiledObserver.build(folder, flags=(*STRICT, *TRAPPED))
        assert compiled.selftest() == 0
        found, bits = compiled.run(y, u)
        np.testing.assert_array_equal(bits, status)
        assert apart(found, wanted) < close


@needs_compiler
def test_the_selftest_leaves_out_bits_at_a_threshold(tmp_path):
    """The bound of the monitor is the level that it ends with: rounding decides, and no compiler's self-test fails on it."""
    observer = MACHINES["monitor"]()
    golden = Golden.of(observer)
    running = observer.start(golden.y[0])
    for k in range(golden.passes * len(golden.y)):
        running.step(golden.y[k % len(golden.y)], golden.u[k % len(golden.y)])
    for sign in (-1, 1):
        limits = observer.monitor.limits * 10 ** (running.level_db / 10) * (1 + sign * 1e-13)
        exact = replace(observer, monitor=replace(observer.monitor, limits=limits))
        masked = Golden.of(exact, tolerance=1e-9)
        assert not masked.sure[1, -1] & 8
        assert masked.sure[1, -1] & 4
        assert CompiledObserver.build(export_c(exact, tmp_path / f"c{sign}", "drive")).selftest() == 0


@needs_compiler
def test_a_filter_bank_of_two_sensors_of_which_one_or_both_are_lost(tmp_path):
    observer, rng, (y, u) = filters(measured=(0, 2)), np.random.default_rng(3), samples(550)
    y = np.column_stack([y, 0.3 * np.cos(0.02 * np.arange(550))])
    y[0, 0], y[:7, 1], y[200:260, 0], y[240:300, 1], y[500:520] = np.nan, np.nan, np.nan, np.nan, np.nan
    y[rng.random(y.shape) < 0.05] = np.nan
    wanted, status = in_python(observer, y, u)
    compiled = CompiledObserver.build(export_c(observer, tmp_path / "c", "drive"), flags=STRICT)
    assert compiled.selftest() == 0
    found, bits = compiled.run(y, u)
    np.testing.assert_array_equal(bits, status)
    assert apart(found, wanted) < 1e-9
    begun = y[10:310], u[10:310]  # by the compiled loop, too
    batch = run_observer(observer, *(np.repeat(each[:, None], 3, axis=1) for each in begun))
    assert apart(batch[1:, 2], in_python(observer, *begun)[0][:-1]) < 1e-9


@needs_compiler
@pytest.mark.parametrize(
    ("kind", "precision"), [("limits", "float"), ("through the input", "double"), ("filter bank", "double")]
)
def test_a_parameter_that_follows_the_machine(kind, precision, tmp_path):
    observer, (y, u), close = MACHINES[kind](), samples(250), 1e-9 if precision == "double" else 1e-4
    wanted, status = in_python(observer, y, u, "phase")
    folder = export_c(observer, tmp_path / "c", "drive", precision, track="phase")
    compiled = CompiledObserver.build(folder, flags=(*STRICT, "-Wno-unused-function"))
    assert compiled.selftest() == 0
    found, bits = compiled.run(y, u)
    np.testing.assert_array_equal(bits, status)
    assert apart(found, wanted) < close
    assert apart(in_python(observer, y, u)[0], wanted) > 10 * close  # the parameter moved


@needs_compiler
@pytest.mark.parametrize(("precision", "limit"), [("double", np.inf), ("double", 0.05), ("float", 0.05)])
def test_load_torque_with_its_level(precision, limit, tmp_path):
    """Also where the current meets its limit, and angles are missing."""
    import ctypes

    rng, count = np.random.default_rng(7), 3000
    angle = (3 * np.sin(2e-3 * np.arange(count)))[:, None]
    angle[0], angle[500:510] = np.nan, np.nan
    estimate = np.stack([angle[:, 0], *(0.1 * np.cumsum(rng.normal(size=(2, count)), axis=1) / 30)], axis=1)
    level = AngleLoad(2.0, 1e-3, limit=limit)
    wanted = level.run(estimate[:, 1:2], estimate[:, 2:], angle)
    outputs = LoadOutput(level, load="velocity", current="current")
    folder = export_c(drive(), tmp_path / "c", "drive", precision, load=outputs)
    library = CompiledObserver.build(folder, flags=STRICT)
    real = np.float32 if precision == "float" else np.float64
    kept, found = np.zeros(12), np.empty((count, 2), dtype=real)
    at = kept.ctypes.data_as(ctypes.c_void_p)
    library._c.drive_load_init(at)
    for k in range(count):
        x_hat, value = (
            np.nan_to_num(estimate[k]).astype(real),
            (ctypes.c_float if precision == "float" else ctypes.c_double)(angle[k, 0]),
        )
        places = [ctypes.c_void_p(a.ctypes.data) for a in (x_hat, found[k, :1], found[k, 1:])]
        library._c.drive_load_step(at, places[0], value, *places[1:])
    for got, truth in zip(found.T, (wanted.load[:, 0], wanted.current[:, 0]), strict=True):
        assert np.isfinite(truth).all()
        np.testing.assert_allclose(got, truth, atol=(1e-12 if precision == "double" else 1e-5))
    if np.isfinite(limit):
        assert np.count_nonzero(np.abs(wanted.current) == limit) > 50


@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
def test_everything_compiles_without_a_warning(precision, tmp_path):
    folder = export_c(watched(drive(delay=2, **LIMITS)), tmp_path / "c", "drive", precision)
    size = 'extern int printf(const char *, ...);\n#include "drive.h"\nint main(void) { printf("%d", (int)sizeof(drive_state)); return 0; }\n'
    (folder / "size.c").write_text(size)
    for source in ("drive.c", "drive_selftest.c", "example_main.c"):
        subprocess.run(["cc", *STRICT, "-c", source, "-o", f"{source}.o"], cwd=folder, check=True)
    symbols = subprocess.run(["nm", "drive.c.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
    kinds = {line.split()[-2] for line in symbols.splitlines()}
    assert not kinds & {"B", "b", "D", "d", "C"}  # no variables that can be written
    assert {line.split()[-1] for line in symbols.splitlines() if " U " in line} <= {
        "sin",
        "cos",
        "floor",
        "sinf",
        "cosf",
    }
    subprocess.run(
        ["cc", "drive.c.o", "drive_selftest.c.o", "example_main.c.o", "-lm", "-o", "example"], cwd=folder, check=True
    )
    subprocess.run(["./example"], cwd=folder, check=True)
    sources = ("drive.c", "drive_selftest.c", "example_main.c")
    sanitized = ["cc", *STRICT, "-fsanitize=address,undefined", *sources, "-lm", "-o", "sanitized"]
    if (
        subprocess.run(sanitized, cwd=folder, check=False, capture_output=True).returncode == 0
    ):  # not every compiler comes with the library
        subprocess.run(["./sanitized"], cwd=folder, check=True)
    subprocess.run(["cc", "size.c", "-o", "size"], cwd=folder, check=True)
    printed = subprocess.run(["./size"], cwd=folder, check=True, capture_output=True, text=True).stdout
    assert f'"state_bytes": {printed},' in (folder / "manifest.json").read_text()


@pytest.mark.skipif(shutil.which("cppcheck") is None, reason="cppcheck is not on the PATH")
def test_misra_deviations_are_those_that_the_documentation_lists(tmp_path):
    outputs = LoadOutput(AngleLoad(2.0, 1e-3, limit=0.3), load="velocity")
    folder = export_c(watched(drive(**LIMITS)), tmp_path / "c", "drive", "float", track="phase", load=outputs)
    sources = ("drive.c", "drive_selftest.c", "example_main.c")
    command = ["cppcheck", "-q", "--addon=misra", "--std=c99", "--enable=style", *sources]
    said = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    assert set(re.findall(r"\[([\w.-]+)\]$", said.stdout + said.stderr, re.MULTILINE)) <= {
        f"misra-c2012-{r}" for r in ("2.5", "8.7", "8.9")
    }


@needs_compiler
def test_the_filtered_estimate(tmp_path):
    import ctypes

    observer, (y, u) = drive(delay=1), samples(50, faults=False)
    library = CompiledObserver.build(export_c(observer, tmp_path / "c", "drive"))
    state, x_hat, running = np.zeros(100), np.zeros(3), observer.start(y[0])
    at = [a.ctypes.data_as(ctypes.c_void_p) for a in (state, x_hat)]
    library._c.drive_init(at[0])
    library._c.drive_reset(at[0], y[:1].ctypes.data_as(ctypes.c_void_p))
    for k in range(49):
        row = [np.ascontiguousarray(v).ctypes.data_as(ctypes.c_void_p) for v in (y[k], u[k], y[k + 1])]
        library._c.drive_step(at[0], row[0], row[1], at[1])
        running.step(y[k], u[k])
        library._c.drive_filter(at[0], row[2], at[1])
        np.testing.assert_allclose(x_hat, np.asarray(running.filter(y[k + 1])), rtol=1e-12, atol=1e-14)


def test_the_same_observer_gives_the_same_bytes(tmp_path):
    one, two = (export_c(drive(), tmp_path / name, "drive") for name in ("one", "two"))
    assert {p.name: p.read_bytes() for p in one.iterdir()} == {p.name: p.read_bytes() for p in two.iterdir()}


@pytest.mark.parametrize("name", ["", "1st", "a-b", "int", "ü", "x" * 60])
def test_a_name_that_is_no_identifier_is_refused(name, tmp_path):
    with pytest.raises(ConfigError, match="C identifier"):
        export_c(drive(), tmp_path / "c", name)
    assert not list(tmp_path.iterdir())


def test_a_folder_with_content_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(DataError, match="not empty"):
        export_c(drive(), tmp_path, "drive")
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_an_estimate_within_rounding_of_its_limit_is_not_sure_to_be_inside():
    lag = Observer.open_loop("lag", Lifting(("x",)), np.zeros((1, 1)), np.ones((1, 1)), (0,), ("u",), 0.01)
    limited = replace(lag, runtime=Runtime(upper=np.array([Golden.of(lag).x_hat.max() + 1e-6])))
    golden = Golden.of(limited, tolerance=1e-3)
    assert not (golden.status & SampleStatus.LIMIT).any()
    assert 0 < np.sum(golden.sure[0] & SampleStatus.LIMIT == 0) < len(golden.status)
