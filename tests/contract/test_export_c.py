"""Generated C against the observer in Python: estimates, status bits, precision after many turns, and compilers that complain about nothing."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError
from kros.core.lti import StateSpace
from kros.export import CompiledObserver, export_c, find_compiler
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, Seen
from kros.synthesis import Injection

STATES, DT = ("position", "velocity", "current"), 1e-3
GEAR = ("sin(100*position + phase)", "cos(100*position + phase)")
SMOOTH = (
    "position**2",
    "tanh(velocity)",
    "abs(current)*sign(velocity)",
    "exp(-velocity**2)",
    "sqrt(1 + position**2)",
    "(1 + position**2)**1.3/(2 + velocity**2)",
)
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror", "-pedantic")
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler is on the PATH")


def drive(functions=GEAR, order=2, inputs=(), gamma=(), injection=Injection.STATE, **runtime):
    lifting = Lifting(STATES, functions, tuple(p for p in ("phase",) if any(p in f for f in functions)), inputs, gamma)
    rng, n, m = np.random.default_rng(5), lifting.n_lifted, 2 + len(gamma)
    A, B = 0.9 * np.eye(n), np.zeros((n, m))
    A[:3, :3] = [[0.99, DT, 0], [-0.5, 0.9, 0.01], [0, 0, 0.9]]
    A[:3, 3:] = 1e-3 * rng.normal(size=(3, n - 3))
    B[:3, :2], B[2, 2:] = [[0.01, 0], [0.5, 0.02], [0.01, 0]], 1e-3
    width = m if injection is Injection.INPUT else n
    K = StateSpace(
        0.9 * np.eye(order),
        0.1 * rng.normal(size=(order, 1)),
        0.01 * rng.normal(size=(width, order)),
        0.01 * rng.normal(size=(width, 1)),
        DT,
    )
    parameters = {"phase": 0.3} if lifting.parameters else {}
    seen = Seen(np.array([1.5]), np.array([2.0, 9.0]))
    return Observer("drive", lifting, A, B, (0,), ("target", "rate"), K, injection, DT, parameters, Runtime(**runtime), seen)


LIMITS = {"lower": [-np.inf, -2, -0.3], "upper": [np.inf, 2, 0.3]}
MACHINES = {
    "lifted": lambda: drive(),
    "gain": lambda: drive(order=0),
    "linear": lambda: drive(()),
    "delay": lambda: drive(delay=3),
    "limits": lambda: drive(correction=np.full(5, 0.004), **LIMITS),
    "delay and limits": lambda: drive(delay=2, correction=np.full(5, 0.004), **LIMITS),
    "input limits": lambda: drive(input_lower=[-1, -2], input_upper=[1, 2]),
    "through the input": lambda: drive(injection=Injection.INPUT, correction=np.full(2, 0.01)),
    "every function": lambda: drive(SMOOTH),
    "earlier values": lambda: drive(("sin(position[-2])", "rate[-1]*velocity"), inputs=("target", "rate")),
    "earlier values and delay": lambda: drive(("sin(position[-2])", "rate[-1]*velocity"), inputs=("target", "rate"), delay=3),
    "input functions": lambda: drive(inputs=("target", "rate"), gamma=("rate*velocity",)),
    "replaced": lambda: replaced(),
}


def replaced():
    """A measurement takes the place of the estimate; two internal states."""
    lifting = Lifting((*STATES, "memory_1", "memory_2"), GEAR, ("phase",))
    rng = np.random.default_rng(3)
    A = np.zeros((7, 7))
    A[:5, :5] = 0.9 * np.eye(5) + 0.01 * rng.normal(size=(5, 5))
    A[:5, 5:] = 1e-3 * rng.normal(size=(5, 2))
    A[0, 0] = 1.0
    B = np.vstack([0.01 * rng.normal(size=(5, 2)), np.zeros((2, 2))])
    gain = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((7, 0)), A[:, :1], DT)
    seen = Seen(np.array([1.5]), np.array([2.0, 9.0]))
    return Observer(
        "r", lifting, A, B, (0,), ("target", "rate"), gain, Injection.STATE, DT, {"phase": 0.3}, seen=seen, replaces=True, internal=2
    )


def samples(count, turns=0.0, faults=True):
    rng, t = np.random.default_rng(1), np.arange(count) * DT
    y = (np.sin(3 * t - 0.05) + 1e-4 * rng.normal(size=count) + 2 * np.pi * turns)[:, None]
    u = np.stack([np.sin(3 * t) + 2 * np.pi * turns, 3 * np.cos(3 * t)], axis=1)
    if faults:
        y[rng.integers(0, count, count // 50)], y[rng.integers(0, count, 20)] = np.nan, 50
        u[rng.integers(0, count, count // 80), 0], u[count // 2 : count // 2 + 20] = np.inf, np.nan
        y[0] = np.nan
    return y, u


def in_python(observer, y, u):
    running = observer.start(y[0])
    found = [(np.asarray(running.step(*sample)), int(running.status)) for sample in zip(y, u, strict=True)]
    return np.array([x for x, _ in found])[:, : len(observer.recorded)], np.array([status for _, status in found])


def apart(found, wanted):
    return (np.sqrt(np.mean((found - wanted) ** 2, axis=0)) / np.sqrt(np.mean((wanted - wanted.mean(axis=0)) ** 2, axis=0))).max()


@needs_compiler
@pytest.mark.parametrize("kind", MACHINES)
def test_same_estimates_and_the_same_status_under_faults(kind, tmp_path):
    observer, (y, u) = MACHINES[kind](), samples(800)
    wanted, status = in_python(observer, y, u)
    assert len(set(status)) >= 4
    for precision, close in (("double", 1e-9), ("float", 1e-4)):
        folder = export_c(observer, tmp_path / precision, "drive", precision)
        compiled = CompiledObserver.build(folder, flags=(*STRICT, "-Wno-unused-function"))
        assert compiled.selftest() == 0
        found, bits = compiled.run(y, u)
        np.testing.assert_array_equal(bits, status)
        assert apart(found, wanted) < close


@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_thousand_turns_cost_no_accuracy(precision, tmp_path):
    observer, (y, u) = replace(drive(), seen=None), samples(4000, turns=1000, faults=False)
    found, _ = CompiledObserver.build(export_c(observer, tmp_path / "c", "drive", precision)).run(y, u)
    assert apart(found, in_python(observer, y, u)[0]) < (1e-9 if precision == "double" else 1e-4)


@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
def test_everything_compiles_without_a_warning(precision, tmp_path):
    folder = export_c(drive(delay=2, **LIMITS), tmp_path / "c", "drive", precision)
    size = (
        'extern int printf(const char *, ...);\n#include "drive.h"\nint main(void) { printf("%d", (int)sizeof(drive_state)); return 0; }\n'
    )
    (folder / "size.c").write_text(size)
    for source in ("drive.c", "drive_selftest.c", "example_main.c"):
        subprocess.run(["cc", *STRICT, "-c", source, "-o", f"{source}.o"], cwd=folder, check=True)
    symbols = subprocess.run(["nm", "drive.c.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
    kinds = {line.split()[-2] for line in symbols.splitlines()}
    assert not kinds & {"B", "b", "D", "d", "C"}  # no variables that can be written
    assert {line.split()[-1] for line in symbols.splitlines() if " U " in line} <= {"sin", "cos", "floor", "sinf", "cosf"}
    subprocess.run(["cc", "drive.c.o", "drive_selftest.c.o", "example_main.c.o", "-lm", "-o", "example"], cwd=folder, check=True)
    subprocess.run(["./example"], cwd=folder, check=True)
    subprocess.run(["cc", "size.c", "-o", "size"], cwd=folder, check=True)
    printed = subprocess.run(["./size"], cwd=folder, check=True, capture_output=True, text=True).stdout
    assert f'"state_bytes": {printed},' in (folder / "manifest.json").read_text()


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
