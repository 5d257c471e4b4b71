"""Reliability of H-infinity synthesis: random plants against norms that others compute.

    python benchmarks/reliability/hinf.py --count 1000

Controllers of SLICOT (sb10fd, sb10dd at many levels) and norms by SLICOT (ab13dd) need slycot; without it the controllers are those of kros at other
levels, and the norms those of dense grids around the poles.
"""

from __future__ import annotations

import importlib.util
import itertools
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from campaign import Tally, main

from kros.core import KrosError, StateSpace
from kros.synthesis import GeneralizedPlant, hinf

SLYCOT = importlib.util.find_spec("slycot") is not None
LEVELS = (0.3, 0.7, 0.9, 0.98, 0.999, 1.0001, 1.002, 1.05, 2.0)
FALSE = 1e-6  # a bound this far above an attained norm, as a fraction of it, is false


def random_dynamics(rng: np.random.Generator, n: int, dt: float, damping: float | None) -> np.ndarray:
    """Random A; lightly damped modes where a damping is given, unstable plants in one of four cases otherwise."""
    if damping is None:
        A = rng.standard_normal((n, n))
        stable = rng.random() < 0.75
        if dt > 0:
            return A * (
                (rng.uniform(0.5, 0.99) if stable else rng.uniform(1.01, 1.6)) / np.abs(np.linalg.eigvals(A)).max()
            )
        return A - (
            np.linalg.eigvals(A).real.max() + (rng.uniform(0.02, 1) if stable else -rng.uniform(0.02, 1))
        ) * np.eye(n)
    blocks = np.zeros((n, n))
    for k in range(0, n - 1, 2):
        w = 10 ** rng.uniform(-1, 1) if dt == 0 else rng.uniform(0.05, 3.0)
        s = complex(-damping * w, w)
        s = np.exp(s) if dt > 0 else s
        blocks[k : k + 2, k : k + 2] = [[s.real, s.imag], [-s.imag, s.real]]
    if n % 2:
        blocks[-1, -1] = -0.3 if dt == 0 else 0.7
    T = rng.standard_normal((n, n)) + 2 * np.eye(n)
    return np.asarray(T @ blocks @ np.linalg.inv(T))


def random_plant(rng: np.random.Generator, dt: float, family: str) -> GeneralizedPlant:
    """One regular plant: w = (disturbances, noise), z = (outputs, penalty), or all feedthroughs full."""
    n, d, m, e, q = (int(rng.integers(1, k)) for k in (7, 3, 3, 3, 3))
    damping = 10 ** rng.uniform(-6, -1) if family == "lightly damped" else None
    A = random_dynamics(rng, n, dt, damping)
    noise, penalty = 10 ** rng.uniform(-6, 0.5, 2) if family in ("small", "scaled") else 10 ** rng.uniform(-2, 0.5, 2)
    B1, C1 = (
        np.hstack([rng.standard_normal((n, d)), np.zeros((n, q))]),
        np.vstack([rng.standard_normal((e, n)), np.zeros((m, n))]),
    )
    D12, D21 = np.vstack([np.zeros((e, m)), penalty * np.eye(m)]), np.hstack([np.zeros((q, d)), noise * np.eye(q)])
    D11 = np.zeros((e + m, d + q))
    if family == "full":
        B1, C1 = rng.standard_normal(B1.shape), rng.standard_normal(C1.shape)
        D11, D12, D21 = (rng.standard_normal(x.shape) for x in (D11, D12, D21))
    B2, C2 = rng.standard_normal((n, m)), rng.standard_normal((q, n))
    if family == "scaled":
        t, c, y = 10 ** rng.uniform(-4, 4, n), 10 ** rng.uniform(-4, 4, m), 10 ** rng.uniform(-4, 4, q)
        A, B1, B2, C1, C2 = A * t[:, None] / t, B1 * t[:, None], B2 * t[:, None] * c, C1 / t, C2 / t * y[:, None]
        D12, D21 = D12 * c, D21 * y[:, None]
    return GeneralizedPlant(A, B1, B2, C1, C2, D11, D12, D21, np.zeros((q, m)), dt)


def closed_loop(p: GeneralizedPlant, K: StateSpace) -> tuple[np.ndarray, ...]:
    """Closed loop for D22 = 0, written out here."""
    A = np.block([[p.A + p.B2 @ K.D @ p.C2, p.B2 @ K.C], [K.B @ p.C2, K.A]])
    B = np.vstack([p.B1 + p.B2 @ K.D @ p.D21, K.B @ p.D21])
    C = np.hstack([p.C1 + p.D12 @ K.D @ p.C2, p.D12 @ K.C])
    return A, B, C, p.D11 + p.D12 @ K.D @ p.D21


def norm(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, dt: float, below: float = np.inf) -> float:
    """H-infinity norm by SLICOT and by a dense grid around the poles where it may lie below a value; infinite for an unstable system."""
    if not all(np.isfinite(x).all() for x in (A, B, C, D)):
        return float("inf")
    poles = np.linalg.eigvals(A)
    # A pole within rounding of the boundary is not called stable.
    if (
        (np.abs(poles).max(initial=0) >= 1 - 1e-10)
        if dt > 0
        else (poles.real.max(initial=-1) >= -1e-10 * np.abs(poles).max(initial=1))
    ):
        return float("inf")
    if SLYCOT and len(A):
        import slycot

        n, m, p = len(A), B.shape[1], len(C)
        try:
            found = slycot.ab13dd("D" if dt > 0 else "C", "I", "S", "D", n, m, p, A, np.eye(n), B, C, D, 1e-9)[0]
        except ArithmeticError:
            found = 0.0
        return float(found) if found >= below else max(float(found), gridded(A, B, C, D, dt))
    return gridded(A, B, C, D, dt)


def gridded(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, dt: float) -> float:
    """Largest gain on a dense grid around the poles, refined between the neighbours of its highest points."""
    system, freqs = StateSpace(A, B, C, D, dt), dense(A, dt)
    gains = np.linalg.norm(system.frequency_response(freqs), 2, axis=(-2, -1))
    best = max(float(gains.max()), float(np.linalg.norm(D, 2)) if dt == 0 and D.size else 0.0)  # the grid ends before D
    for k in np.argsort(-gains)[:5]:
        low, high = freqs[max(k - 1, 0)], freqs[min(k + 1, len(freqs) - 1)]
        for _ in range(6):
            inner = np.linspace(low, high, 21)
            found = np.linalg.norm(system.frequency_response(inner), 2, axis=(-2, -1))
            best, top = max(best, float(found.max())), int(found.argmax())
            low, high = inner[max(top - 1, 0)], inner[min(top + 1, 20)]
    return best


def dense(A: np.ndarray, dt: float) -> np.ndarray:
    """Frequencies in Hz: logarithmic, and within every pole's width."""
    poles = np.linalg.eigvals(A).astype(complex)
    s = np.log(poles[np.abs(poles) > 0]) if dt > 0 else poles
    width = np.sinh(np.linspace(-6, 6, 41)) / 3
    around = (np.abs(s.imag)[:, None] + np.abs(s.real)[:, None] * width).ravel()
    top = np.pi if dt > 0 else 100 * max(float(np.abs(poles).max(initial=1.0)), 1e-12)
    rad = np.unique(np.clip(np.concatenate([[0.0], np.geomspace(1e-7 * top, top, 300), around]), 0.0, top))
    return rad / (2 * np.pi * (dt or 1.0))


def controllers(p: GeneralizedPlant, level: float) -> Iterator[StateSpace]:
    """Controllers of others at one level."""
    n, n_w, n_u, n_z, n_y = p.sizes
    if SLYCOT:
        import slycot

        s = p.open_loop()
        routine = slycot.sb10dd if p.dt > 0 else slycot.sb10fd
        try:
            out = routine(n, n_w + n_u, n_z + n_y, n_u, n_y, level, s.A, s.B, s.C, s.D, 1e-14)
            yield StateSpace(*[x for x in out if np.ndim(x) == 2][:4], p.dt)  # type: ignore[call-arg]
        except (ArithmeticError, ValueError):
            return


def attained(p: GeneralizedPlant, own: StateSpace, value: float) -> tuple[float, float]:
    """Return the norm of kros's own controller, and the smallest norm of any controller tried.

    Controllers of plants with more noise and penalty are tried too: where those are tiny, SLICOT fails on the plant itself.
    """
    mine = norm(*closed_loop(p, own), p.dt)  # type: ignore[call-arg]
    best = mine
    for calmer in (1.0, 30.0) if SLYCOT else ():
        easier = replace(p, D12=calmer * p.D12, D21=calmer * p.D21)
        for share in LEVELS:
            for K in controllers(easier, share * value):
                best = min(best, norm(*closed_loop(p, K), p.dt, below=best))  # type: ignore[call-arg]
    for tolerance in () if SLYCOT else (0.3, 0.005):
        try:
            best = min(best, norm(*closed_loop(p, hinf(p, tolerance=tolerance).controller), p.dt))  # type: ignore[call-arg]
        except KrosError:
            continue
    return mine, best


def judge(tally: Tally, tried: Callable[[], tuple[str, bool]]) -> None:
    """Count one case; anything but an answer or a KrosError is a traceback."""
    began = time.perf_counter()
    try:
        outcome, failed = tried()
    except KrosError as error:
        outcome, failed = (
            ("internal error", True) if "internal error" in str(error) else ("refused with a reason", False)
        )
    except Exception as error:
        outcome, failed = f"traceback ({type(error).__name__})", True
    tally.add(outcome, time.perf_counter() - began, failed)


def optimum(rng: np.random.Generator, dt: float, family: str) -> Callable[[], tuple[str, bool]]:
    """One case of `hinf`."""
    plant = random_plant(rng, dt, family)

    def tried() -> tuple[str, bool]:
        found = hinf(plant)
        lower = found.lower_bound or 0.0
        mine, best = attained(plant, found.controller, lower or found.hinf_norm or 1.0)
        if lower > best * (1 + FALSE):
            return "false bound", True
        if not np.isfinite(mine) or abs(mine / (found.hinf_norm or mine) - 1) > 1e-3:
            return "norm not confirmed", not np.isfinite(mine) or mine > (found.hinf_norm or 0) * (1 + 1e-3)
        if found.status.value == "optimal":
            return ("optimal", False) if best >= mine * (1 - 1e-3) or mine < 1e-7 else ("not the optimum", True)
        return (
            f"bounded within {'1 %' if mine <= 1.01 * lower else '10 %' if mine <= 1.1 * lower else 'more than 10 %'}",
            False,
        )

    return tried


def run(count: int, seed: int) -> list[Tally]:
    """Try `count` plants, and a tenth as many of the other kinds."""
    truth = (
        "controllers by SLICOT sb10fd, sb10dd at 9 levels, on calmer plants too, norms by ab13dd and a dense grid"
        if SLYCOT
        else "other levels, a dense grid"
    )
    kind = {
        "small": "small penalties and noises",
        "scaled": "the same in units of many sizes",
        "full": "every feedthrough",
    }
    tallies = []
    for family, dt in itertools.product(("small", "scaled", "lightly damped", "full"), (0.0, 1.0)):
        name = f"H-infinity optimum, {kind.get(family, family)}, {'discrete' if dt else 'continuous'}"
        make = partial(optimum, family=family)
        tallies.append(_tried(Tally(name, truth), make, dt, count // 8, np.random.default_rng([seed, len(tallies)])))
    return tallies


def _tried(
    tally: Tally, make: Callable[..., Callable[[], tuple[str, bool]]], dt: float, count: int, rng: np.random.Generator
) -> Tally:
    for _ in range(max(count, 1)):
        judge(tally, make(rng, dt))
    return tally


if __name__ == "__main__":
    warnings.simplefilter("error", RuntimeWarning)
    main("hinf", "H-infinity bounds", run, 1000)
