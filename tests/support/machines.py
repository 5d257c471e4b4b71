"""Machines with observers of every kind, samples with faults, and what the observer in Python makes of them."""

from dataclasses import replace

import numpy as np

from kros.core.lti import StateSpace
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, Seen
from kros.observer.filter_bank import FilterBank
from kros.observer.monitor import Monitor, octaves
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


def drive(functions=GEAR, order=2, inputs=(), gamma=(), injection=Injection.STATE, **runtime):
    lifting = Lifting(STATES, functions, tuple(p for p in ("phase",) if any(p in f for f in functions)), inputs, gamma)
    rng, n, m = np.random.default_rng(5), lifting.n_lifted, 2 + len(gamma)
    A, B = 0.9 * np.eye(n), np.zeros((n, m))
    A[:3, :3] = [[0.99, DT, 0], [-0.5, 0.9, 0.01], [0, 0, 0.9]]
    A[:3, 3:] = 1e-3 * rng.normal(size=(3, n - 3))
    B[:3, :2], B[2, 2:] = [[0.01, 0], [0.5, 0.02], [0.01, 0]], 1e-3
    width = m if injection is Injection.INPUT else n
    K_B, K_C, K_D = (rng.normal(size=shape) for shape in ((order, 1), (width, order), (width, 1)))
    K = StateSpace(0.9 * np.eye(order), 0.1 * K_B, 0.01 * K_C, 0.01 * K_D, DT)
    parameters = {"phase": 0.3} if lifting.parameters else {}
    seen = Seen(np.array([1.5]), np.array([2.0, 9.0]))
    return Observer(
        "drive", lifting, A, B, (0,), ("target", "rate"), K, injection, DT, parameters, Runtime(**runtime), seen
    )


START = [0, 1.5, -0.2]
LIMITS = {"lower": [-np.inf, -2, -0.3], "upper": [np.inf, 2, 0.3]}
MACHINES = {
    "lifted": lambda: drive(),
    "gain": lambda: drive(order=0),
    "linear": lambda: drive(()),
    "limits": lambda: drive(**LIMITS),
    "limits, delay and start": lambda: drive(delay=2, start=START, **LIMITS),
    "through the input": lambda: drive(injection=Injection.INPUT),
    "every function": lambda: drive(SMOOTH),
    "earlier values and delay": lambda: drive(
        ("sin(position[-2])", "rate[-1]*velocity"), inputs=("target", "rate"), delay=3
    ),
    "input functions": lambda: drive(inputs=("target", "rate"), gamma=("rate*velocity",)),
    "filter bank": lambda: filters(),
    "filter bank with limits": lambda: filters(cut=True),
    "filter bank without functions": lambda: filters(()),
    "monitor": lambda: watched(drive()),
    "monitor and delay": lambda: watched(drive(delay=2, **LIMITS)),
}


def filters(functions=GEAR, cut=False, measured=(0,)):
    """A filter bank with two filters, and one of inputs alone."""
    parameters = ("phase",) if functions else ()
    fallback = tuple(f"{name}_{what}" for what in ("error", "from_inputs") for name in STATES)
    states = (*STATES, "filter_1", "filter_2", "input_filter_1", *fallback)
    lifting = Lifting(states, functions, parameters, ("target", "rate"), ("rate*position", "1"))
    rng, n, p = np.random.default_rng(3), lifting.n_states, lifting.n_lifted
    A, B = np.zeros((p, p)), np.zeros((p, 4))
    seen, others = [*measured, *range(n, p)], [i for i in range(n) if i not in measured]
    A[:5, seen], B[:5] = 0.1 * rng.normal(size=(5, len(seen))), 0.1 * rng.normal(size=(5, 4))
    A[:5, 3:5] = [[0.1, 0.0], [0.5, 0.1], [0.0, 0.7], [0.9, 0.1], [-0.1, 0.9]]
    A[:5, n:] *= 0.01  # slopes of a gear are large
    A[0, 0] += 0.8
    A[5, 5], B[5, [0, 1, 3]] = 0.95, [0.05, 0.01, 0.02]
    A[6:9, [0, 3, 4]] = [[0.9, 0.2, 0.1], [0.0, 0.1, 0.2], [0.1, 0.0, 0.1]]
    A[9:12, 5], B[9:12, [0, 1, 3]] = [0.3, 0.1, 0.0], [[0.7, 0.01, 0.0], [0.0, 0.9, 0.1], [0.1, 0.1, 0.1]]
    start = 0.1 * rng.normal(size=(n, p + 4))
    start[:, others] = 0.0  # states that are not measured are not known
    q = len(measured)
    doubt, half = np.array([[0.02, 0.01], [0.01, 0.03]]), np.array([0.1, 0.05, 0.2])
    rows = [0.2, 0.3], [0.02, 0.03], [0.1, 0.2], [1.0, 2.0], [2.0, 5.0], [3.0, 4.0]
    of_measurements = (np.array(row[:q]) for row in rows)
    bank = FilterBank(2, start, np.array([0.95]), doubt, half, *of_measurements, np.array([0.99, 0.6]))
    none = StateSpace(np.zeros((0, 0)), np.zeros((0, q)), np.zeros((p, 0)), np.zeros((p, q)), DT)
    low, high = (np.append(LIMITS[side], np.full(n - 3, end)) for side, end in (("lower", -np.inf), ("upper", np.inf)))
    first = np.append([0.4, 0.1, -0.1], np.zeros(n - 3))
    runtime = Runtime(0, low, high, first) if cut else Runtime(start=first)
    parts = (
        lifting,
        A,
        B,
        measured,
        ("target", "rate"),
        none,
        Injection.STATE,
        DT,
        {"phase": 0.3} if functions else {},
    )
    return Observer("filters", *parts, runtime, Seen(np.full(q, 1.5), np.array([2.0, 9.0])), bank=bank)


def watched(observer, bound=1.0):
    """With a monitor that is exceeded now and then by what `samples` does."""
    filters, weights = octaves(), np.array([[4, 3, 3, 0, 3, 3]])
    limits = bound * np.full(weights.shape, 0.02)
    monitor = Monitor(filters, 0.02, 50, np.array([0.7]), limits, weights, 0.02, first=0.1)
    return replace(observer, monitor=monitor)


def samples(count, turns=0.0, faults=True):
    rng, t = np.random.default_rng(1), np.arange(count) * DT
    y = (np.sin(3 * t - 0.05) + 1e-4 * rng.normal(size=count) + 2 * np.pi * turns)[:, None]
    u = np.stack([np.sin(3 * t) + 2 * np.pi * turns, 3 * np.cos(3 * t)], axis=1)
    if faults:
        y[rng.integers(0, count, count // 50)], y[rng.integers(0, count, 20)] = np.nan, 50
        u[rng.integers(0, count, count // 80), 0], u[count // 2 : count // 2 + 20] = np.inf, np.nan
        y[0] = np.nan
    return y, u


def in_python(observer, y, u, track=None):
    running = observer.start(y[0])
    if track is not None:
        running.track(track)
    found = [(np.asarray(running.step(*sample)), int(running.status)) for sample in zip(y, u, strict=True)]
    return np.array([x for x, _ in found]), np.array([status for _, status in found])


def apart(found, wanted):
    return (
        np.sqrt(np.mean((found - wanted) ** 2, axis=0)) / np.sqrt(np.mean((wanted - wanted.mean(axis=0)) ** 2, axis=0))
    ).max()
