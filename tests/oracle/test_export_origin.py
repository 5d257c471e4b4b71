"""Generated code far from zero: a moving origin changes nothing but rounding, against Python."""

from dataclasses import replace

import numpy as np
import pytest
from machines import LIMITS, apart, drive, in_python, samples

from kros.export import CompiledObserver, export_c
from kros.export.c99.origin import find_shift
from kros.loops.compiler import find_compiler
from kros.observer import run_observer
from kros.observer.runtime import Runtime

TURN = 2 * np.pi
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler is on the PATH")


def unbound(observer, **changes):
    """Without a range of plausible angles."""
    return replace(observer, seen=None, **changes)


KINDS = {
    "lifted": lambda: unbound(drive()),
    "linear": lambda: unbound(drive(())),
    "limits": lambda: cancelling(unbound(drive(**LIMITS)), 0.0),
    "late": lambda: unbound(drive(delay=3)),
}


def far_away(turns, count=1500, on=0.0):
    """Motion many turns away, which goes on by so many turns meanwhile; several machines."""
    y, u = samples(count, faults=False)
    ramp = TURN * on * np.linspace(0, 1, count)[:, None]
    away = TURN * np.array([turns, 0.0, -turns])
    y = y[:, None] + ramp[:, None] + away[:, None]
    u = np.repeat(u[:, None], 3, axis=1)
    u[..., 0] += ramp + away
    return y, u


def cancelling(observer, size=300.0):
    """With large columns of reference and measurement that cancel, as those of a machine under control do."""
    A, B, n = observer.A.copy(), observer.B.copy(), observer.lifting.n_states
    B[:n, 0] = -(A[:n, 0] - np.eye(n)[0]) + size * (np.arange(n) > 0)
    A[1:n, 0] -= size
    return replace(observer, A=A, B=B)


@pytest.mark.parametrize("kind", ["lifted", "linear"])
def test_the_direction_leaves_the_model_where_it_is(kind):
    observer = cancelling(KINDS[kind]())
    shift, n = find_shift(observer), observer.lifting.n_states
    A, B = observer.A[:n, :n], observer.B[:n]
    left = (A - np.eye(n)) @ shift.states + B @ shift.whole + B @ shift.rest
    assert np.abs(left).max() < 1e-15 * np.abs(A).max()  # rounding of terms of 300 that cancel
    assert shift.whole.tolist() == [1.0, 0.0]
    assert shift.states[0] == 1.0


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_a_machine_that_turns_on_and_on(kind, tmp_path):
    """Batches, sample by sample and in C, with samples that are lost."""
    observer = KINDS[kind]()
    y, u = far_away(900, 400, on=40)
    u[200:220], y[260, 0], y[330:350] = np.nan, np.nan, np.nan
    batch = run_observer(observer, y, u)
    builds = {p: CompiledObserver.build(export_c(observer, tmp_path / p, "drive", p)) for p in ("double", "float")}
    one, _ = in_python(observer, y[:, 0], u[:, 0])
    assert apart(one[:-1], batch[1:, 0]) < 1e-9
    for precision, compiled in builds.items():
        close = 1e-8 if precision == "double" else 1e-4  # doubles round terms of 300 x 6000 rad that cancel
        assert apart(compiled.run(y[:, 0], u[:, 0])[0], one) < close


def test_what_has_no_direction_has_no_origin():
    assert find_shift(unbound(drive(("position**2",)))) is None
    assert find_shift(unbound(drive(), runtime=Runtime(delay=3))) is not None
