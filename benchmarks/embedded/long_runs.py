"""Generated C of every observer of a finished run, on its held-out recordings: against Python, after a thousand turns, for a day, and by the clock.

    python benchmarks/embedded/long_runs.py RUN [--steps 1000000] [--hours 24] [--only deployed] [--parts python turns day clock]

* python: estimates and status with faults injected (lost measurements and inputs, spikes, values out of range, a sensor that is stuck), in double and single
  precision, and the estimation error without faults. Beside the observers as they are, the deployed one with a delay, with limits, and followed.
* turns: a thousand turns away, in ranges not yet seen, against Python in batches and sample by sample, and against extended precision.
* day: a machine that runs for hours in pieces of an hour with faults, recordings one after the other; and once without, each recording from its start.
* clock: one step in double, beside a loop by hand with as many multiplications and additions and the same functions.
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from kros.data import EpisodeBatch
from kros.evaluate.sensor import as_arriving
from kros.export import CompiledObserver, export_c
from kros.export.c99.numbers import Source
from kros.identify import IdentifiedModels
from kros.observer import Observer
from kros.observer.screen import screened
from kros.observer.simulate import Course, run_observers
from kros.observer.tracking import PhaseLockedLoop
from kros.study.engine.context import open_finished
from kros.study.stages.learning import open_source

TURN = 2 * np.pi
LIMIT, UNCERTIFIED = 4, 8


@dataclass(frozen=True)
class HeldOut:
    """Held-out recordings: what arrives, (n_samples, batch, q) and (n_samples, batch, m), the truth, and parameters."""

    y: np.ndarray
    u: np.ndarray
    states: np.ndarray
    parameters: dict[str, np.ndarray] = field(default_factory=dict)


def main() -> None:
    """Measure the parts that are asked for."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("run", type=Path)
    ask.add_argument("--steps", type=int, default=1_000_000)
    ask.add_argument("--hours", type=float, default=24)
    ask.add_argument("--only", nargs="*", default=())
    ask.add_argument("--parts", nargs="*", default=("python", "turns", "day", "clock"))
    given = ask.parse_args()
    kinds, data = read(given.run)
    kinds = {name: kind for name, kind in kinds.items() if not given.only or name in given.only}
    for part in given.parts:
        print(f"== {part}", flush=True)
        for name, (observer, track) in kinds.items():
            for line in {"python": against_python, "turns": turned, "day": day, "clock": clock}[part](
                observer, track, data, given
            ):
                print(f"{name:<28}{line}", flush=True)


def read(run: Path) -> tuple[dict[str, tuple[Observer, str | None]], HeldOut]:
    """Return the observers of a run with variants of the deployed one, and its held-out recordings."""
    with open_finished(run) as context:
        config, store = context.config, context.store
        paths = sorted(p for p in store.path("observers").glob("*/*.json"))
        kinds: dict[str, tuple[Observer, str | None]] = {
            f"{p.parent.name}/{p.stem}": (Observer.load(p), None) for p in paths
        }
        deployed = Observer.load(store.path("observers", "deployed.json"))
        population, identified = open_source(config), IdentifiedModels.load(run)
    keys = [key for key in identified.facts.test if key.unit in identified.parameters]
    batch = EpisodeBatch.read(population, keys, None, identified.parameters)
    batch = batch.head(int(batch.lengths.min()))
    y = as_arriving(batch, deployed.sensor, population.states).measurements(deployed.measured)
    data = HeldOut(y, batch.inputs, batch.states, batch.parameters)
    n, size = deployed.lifting.n_states, np.abs(data.states).max(axis=(0, 1))
    limit = np.full(n, np.inf)
    limit[1 : len(size)] = 0.7 * size[1:]
    runtime = replace(deployed.runtime, lower=-limit, upper=limit)
    kinds["deployed"] = deployed, None
    kinds["deployed, late"] = replace(deployed, runtime=replace(deployed.runtime, delay=3)), None
    kinds["deployed, limited"] = replace(deployed, runtime=runtime), None
    if deployed.lifting.parameters:
        kinds["deployed, followed"] = deployed, deployed.lifting.parameters[0]
    return kinds, data


def faulty(data: HeldOut, seed: int, share: float = 2e-3) -> tuple[np.ndarray, np.ndarray]:
    """Return y and u with faults: every so often one begins, of one to a hundred samples."""
    rng, y, u = np.random.default_rng(seed), data.y.copy(), data.u.copy()
    count, batch = y.shape[:2]
    for i in range(batch):
        for at in np.flatnonzero(rng.random(count) < share):
            long, kind = int(np.exp(rng.uniform(0, np.log(100)))), rng.integers(6)
            piece = slice(at, at + long)
            if kind == 0:
                y[piece, i] = np.nan
            elif kind == 1:
                u[piece, i, rng.integers(u.shape[2])] = [np.nan, np.inf, -np.inf][rng.integers(3)]
            elif kind == 2:
                y[at, i] *= 40
            elif kind == 3:
                y[piece, i] = y[at, i]  # stuck
            elif kind == 4:
                u[at, i] *= -30
            else:
                y[piece, i] += 2 * np.abs(data.y).max()
    return y, u


def in_python(observer: Observer, y: np.ndarray, u: np.ndarray, own: dict, track: str | None) -> np.ndarray:
    """Return estimates of the recorded states."""
    loop = None if track is None else PhaseLockedLoop(observer, track, y.shape[1])
    return Course(observer, y.shape[1], own, loop).take(y, u).estimates[..., : len(observer.recorded)]


def in_c(
    observer: Observer, y: np.ndarray, u: np.ndarray, own: dict, track: str | None, precision: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return estimates, the first not a number, and status."""
    compiled = build(observer, track, precision)
    found, status = np.full((*y.shape[:2], len(observer.recorded)), np.nan), np.empty(y.shape[:2], dtype=np.uint32)
    for i in range(y.shape[1]):
        x, status[:, i] = compiled.run(y[:, i], u[:, i], {p: float(v[i]) for p, v in own.items()})
        found[1:, i] = x[:-1]
    return found, status


def build(observer: Observer, track: str | None, precision: str) -> CompiledObserver:
    """Export and compile."""
    return CompiledObserver.build(
        export_c(observer, Path(tempfile.mkdtemp()) / "c", "observer", precision, track=track)
    )


def rms(values: np.ndarray) -> np.ndarray:
    """Return the RMS over samples and episodes, of every state."""
    return np.sqrt(np.mean(np.asarray(values[1:], dtype=float) ** 2, axis=(0, 1)))


def against_python(observer: Observer, track: str | None, data: HeldOut, given: argparse.Namespace) -> Iterator[str]:
    """Yield one line: differences of both precisions without and with faults, status, and what single precision loses."""
    own, steps, seed = observer.own(data.parameters), 0, 0
    clean, apart, unlike, loss = {}, {"double": 0.0, "float": 0.0}, {"double": 0, "float": 0}, np.zeros(1)
    met = UNCERTIFIED | (LIMIT if observer.runtime.lower is not None else 0)
    while steps < given.steps:
        y, u = (data.y, data.u) if not steps else faulty(data, seed)
        wanted, bits = in_python(observer, y, u, own, track), screened(observer, y, u).status
        for precision in apart:
            found, status = in_c(observer, y, u, own, track, precision)
            far = float(np.max(rms(found - wanted) / np.std(wanted, axis=(0, 1))))
            if not steps:
                clean[precision] = far
                loss = 100 * (rms(found - data.states) / rms(wanted - data.states) - 1)
            apart[precision] = max(apart[precision], far)
            unlike[precision] += np.count_nonzero((status | met) != (bits | met))
        steps, seed = steps + bits.size, seed + 1
    some = min(20_000, len(data.y))
    yield (
        f"{steps} steps: double {clean['double']:.0e}, float {clean['float']:.0e} of RMS, with faults {apart['double']:.0e}, {apart['float']:.0e}; "
        f"status that differs {unlike['double']}, {unlike['float']}, sample by sample {one_by_one(observer, track, data, some)} of {some}; "
        f"float's error {loss.max():+.3f} %"
    )


def one_by_one(observer: Observer, track: str | None, data: HeldOut, count: int) -> int:
    """Return how often the status, all bits, differs from that of the observer that runs in Python sample by sample."""
    y, u = (part[:count, 0] for part in faulty(data, 99, 1e-2))
    values = {p: float(v[0]) for p, v in observer.own(data.parameters).items()}
    running, wanted = observer.start(y[0], values), np.empty(count, dtype=np.uint32)
    if track is not None:
        running.track(track)
    for k in range(count):
        running.step(y[k], u[k])
        wanted[k] = int(running.status)
    return int(np.count_nonzero(build(observer, track, "double").run(y, u, values)[1] != wanted))


def turned(observer: Observer, track: str | None, data: HeldOut, given: argparse.Namespace) -> Iterator[str]:
    """Yield one line: a thousand turns away, what C, Python and extended precision differ by."""
    observer = replace(observer, seen=None)
    if len(observer.measured) > 1:
        return
    count = min(4000, len(data.y))
    y, u = data.y[:count] + 1000 * TURN, data.u[:count] + 1000 * TURN * least_input(observer)
    states = data.states[:count] + 1000 * TURN * np.eye(data.states.shape[2])[observer.measured[0]]
    own = observer.own(data.parameters)
    wanted = in_python(observer, y, u, own, track)
    size = np.std(wanted, axis=(0, 1))
    double, single = (in_c(observer, y, u, own, track, precision)[0] for precision in ("double", "float"))
    loss = 100 * (rms(single - states) / rms(wanted - states) - 1)

    def far(one: np.ndarray, other: np.ndarray) -> str:
        return f"{np.max(rms(one - other) / size):.0e}"

    exact = ""
    if track is None and not observer.runtime.delay and not np.isfinite(observer.runtime.sides(1)).any():
        truth = extended(observer, y, u, own)
        exact = f", Python {far(wanted, truth)} and C {far(double, truth)} from extended precision"
    alone = in_steps(observer, track, y[:, :1], u[:, :1], own)
    yield (
        f"1000 turns: C {far(double, wanted)} from Python, {far(double[:, :1], alone)} sample by sample{exact}; "
        f"float's error {loss.max():+.3f} %"
    )


def in_steps(observer: Observer, track: str | None, y: np.ndarray, u: np.ndarray, own: dict) -> np.ndarray:
    """Return estimates of the first machine, from the observer that runs in Python sample by sample."""
    running, found = (
        observer.start(y[0, 0], {p: float(v[0]) for p, v in own.items()}),
        np.empty((*y.shape[:2], len(observer.recorded))),
    )
    if track is not None:
        running.track(track)
    for k in range(len(y)):
        found[k, 0] = np.asarray(running.estimate)
        running.step(y[k, 0], u[k, 0])
    return found


def least_input(observer: Observer) -> np.ndarray:
    """Return which inputs are references of the measured state: those that share its name."""
    name = observer.lifting.states[observer.measured[0]]
    return np.array([float(name in own) for own in observer.inputs])


def extended(observer: Observer, y: np.ndarray, u: np.ndarray, own: dict) -> np.ndarray:
    """Return the estimates in extended precision, written out."""
    lifting, K, real = observer.lifting, observer.controller, np.longdouble
    n, first = lifting.n_states, next(run_observers([observer], y[:2], u[:2], own))[0]
    A, B, into, *linear = (
        np.asarray(M, dtype=real) for M in (observer.A[:n], observer.B[:n], observer.into[:n], K.A, K.B, K.C, K.D)
    )
    x, x_c, found = (
        first.astype(real),
        np.zeros((y.shape[1], K.n_states), dtype=real),
        np.empty((*y.shape[:2], n), dtype=real),
    )
    values = {p: np.asarray(own.get(p, observer.parameters.get(p)), dtype=real) for p in lifting.parameters}
    for k in range(len(y)):
        found[k] = x
        named = values | {s: x[:, i] for i, s in enumerate(lifting.states)}
        theta = np.concatenate([x, *(f.evaluate(named)[:, None] for f in lifting.formulas)], axis=1)
        nu = y[k].astype(real) - x[:, list(observer.measured)]
        corrected = (x_c @ linear[2].T + nu @ linear[3].T) @ into.T
        x, x_c = theta @ A.T + u[k].astype(real) @ B.T + corrected, x_c @ linear[0].T + nu @ linear[1].T
    return found[..., : len(observer.recorded)]


def day(observer: Observer, track: str | None, data: HeldOut, given: argparse.Namespace) -> Iterator[str]:
    """Yield lines: hours of motion with faults in both precisions, and without faults."""
    size, own = np.abs(data.states).max(axis=(0, 1)), observer.own(data.parameters)
    hour = round(3600 / observer.sample_period_s)
    for precision, share in (("double", 1e-3), ("float", 1e-3), ("float", 0.0)):
        compiled, rng = build(observer, track, precision), np.random.default_rng(0)
        bits, largest, finite, steps, seed = np.zeros(4, dtype=int), np.zeros(len(size)), True, 0, 0
        outside: dict[int, float] = {}
        while steps < given.hours * hour:
            unit = int(rng.integers(data.y.shape[1]))
            values = {p: float(v[unit]) for p, v in own.items()}
            machine, left = compiled.start(data.y[0, unit], values), min(hour, int(given.hours * hour) - steps)
            same = [i for i in range(data.y.shape[1]) if all(v[i] == v[unit] for v in own.values())] if own else [unit]
            while left > 0:
                at = int(rng.choice(same))
                piece = HeldOut(data.y[:left, at : at + 1], data.u[:left, at : at + 1], data.states)
                y, u = faulty(piece, seed, share) if share else (piece.y, piece.u)
                if not share:
                    machine = compiled.start(y[0, 0], values)
                x, status = compiled.run(y[:, 0], u[:, 0], machine=machine)
                finite &= bool(np.isfinite(x).all())
                largest = np.maximum(largest, np.abs(x).max(axis=0))
                if (status & UNCERTIFIED).any():
                    outside[at] = float(np.mean(status & UNCERTIFIED) / UNCERTIFIED)
                bits += [np.count_nonzero(status & bit) for bit in (1, 2, 4, 8)]
                left, steps, seed = left - len(x), steps + len(x), seed + 1
        times = ", ".join(f"{v:.1f}" for v in largest / size)
        yield (
            f"{precision}, {'with' if share else 'without'} faults: {steps / hour:.2f} h at {1 / observer.sample_period_s:g} Hz, "
            f"{'finite' if finite else 'NOT FINITE'}, largest estimates {times} times the largest recorded; bits 1, 2, 4, 8 in {bits.tolist()} samples"
            + (
                ""
                if share
                else f"; outside the certificate for a share of these of {data.y.shape[1]} episodes: {outside}"
            )
        )


HAND = """
#include <math.h>
static double M[{rows}][{columns}], z[{columns}], next[{rows}];
double by_hand(long count, const double *y, const double *u);
double by_hand(long count, const double *y, const double *u)
{{
    long k;
    int i, j;
    for (k = 0; k < count; k++) {{
        z[0] = y[k];
        z[1] = u[k * {m}];
        {functions}
        for (i = 0; i < {rows}; i++) {{
            double sum = 0.0;
            for (j = 0; j < {columns}; j++) {{
                sum += M[i][j] * z[j];
            }}
            next[i] = sum;
        }}
        for (i = 0; i < {rows} && i < {columns}; i++) {{
            z[i] = next[i];
        }}
    }}
    return z[0];
}}
"""


def clock(observer: Observer, track: str | None, data: HeldOut, given: argparse.Namespace) -> Iterator[str]:
    """Yield one line: time of a step, the best of several runs."""
    from kros.export.c99.write import c_files

    compiled, y, u = (
        build(observer, track, "double"),
        np.ascontiguousarray(data.y[:, 0]),
        np.ascontiguousarray(data.u[:, 0]),
    )
    readme = c_files(Source.of(observer, "observer", "double", track))["README.md"]
    operations = int(next(row for row in readme.splitlines() if row.startswith("| multiplications")).split("|")[2])
    context, rows = (
        Source.of(observer, "observer", "double").context(),
        observer.lifting.n_states + observer.controller.n_states,
    )
    lifted = len(context["sigma"])
    functions = "".join(f"z[{i}] = {'sin' if i % 2 else 'cos'}(100.0 * y[k] + 0.3); " for i in range(lifted))
    text = HAND.format(rows=rows, columns=max(-(-operations // rows), lifted, 2), m=u.shape[1], functions=functions)
    folder = Path(tempfile.mkdtemp())
    (folder / "hand.c").write_text(text)
    import subprocess

    subprocess.run(
        ["cc", "-std=c99", "-O2", "-fPIC", "-shared", "-fno-math-errno", "hand.c", "-o", "hand.so", "-lm"],
        cwd=folder,
        check=True,
    )
    hand = ctypes.CDLL(str(folder / "hand.so")).by_hand
    hand.restype = ctypes.c_double
    places = [a.ctypes.data_as(ctypes.c_void_p) for a in (y, u)]
    machine = compiled.start(y[0])
    generated = best(lambda: compiled.run(y, u, machine=machine)) / len(y)
    by_hand = best(lambda: hand(ctypes.c_long(len(y)), *places)) / len(y)
    yield f"{operations} multiply-adds, {lifted} functions: {1e9 * generated:.0f} ns a step, by hand {1e9 * by_hand:.0f} ns ({generated / by_hand:.2f})"


def best(call: object, times: int = 15) -> float:
    """Return the shortest time of some calls."""
    found = []
    for _ in range(times):
        start = time.perf_counter()
        call()
        found.append(time.perf_counter() - start)
    return min(found)


if __name__ == "__main__":
    main()
