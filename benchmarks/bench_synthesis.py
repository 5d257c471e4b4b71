"""Time and quality of the syntheses on random drive-like problems.

Run with ``python benchmarks/bench_synthesis.py [N]``. Every problem has a closed-loop drive of four states with a pole near one, two inputs, one
measured output, and diagonal uncertainty weights of order 1-5 a channel (6 to 14 states together). A line per problem, a summary at the end.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from scipy.linalg import expm

from kros.core import KrosError, StateSpace, block_diagonal, gain
from kros.synthesis import Injection, ObserverProblem, mixed, worst_case_h2
from kros.synthesis.problem.plants import mixed_plant

DT = 1e-3


def drive(rng: np.random.Generator) -> StateSpace:
    """Cascaded position and velocity loop with a lifted state, sampled at 1 kHz."""

    def about(value: float) -> float:
        return value * float(np.exp(0.1 * rng.standard_normal()))

    torque, friction, position, velocity, current = about(60), about(3), about(12), about(3), about(600)
    A = np.array(
        [
            [0, 1, 0, 0],
            [0, -friction, torque, about(2)],
            [-current * velocity * position, -current * velocity, -current, 0],
            [about(0.5), about(1), 0, -about(30)],
        ]
    )
    B = np.array([[0, 0], [0, 0], [current * velocity * position, current * velocity], [0, 0]])
    sampled = expm(DT * np.block([[A, B], [np.zeros((2, 6))]]))
    return StateSpace(sampled[:4, :4], sampled[:4, 4:], np.eye(4), np.zeros((4, 2)), DT)


def lag(low: float, high: float, corner_hz: float) -> StateSpace:
    """First-order filter with gain `low` at DC and `high` at Nyquist."""
    a = np.exp(-2 * np.pi * corner_hz * DT)
    d, c = np.linalg.solve([[1, 1 / (1 - a)], [1, -1 / (1 + a)]], [low, high])
    return StateSpace([[a]], [[1.0]], [[c]], [[d]], DT)


def problem(seed: int, injection: Injection) -> ObserverProblem:
    """One random problem; the order of the weights follows from the seed."""
    rng = np.random.default_rng(seed)
    nominal = drive(rng)

    def channel() -> StateSpace:
        system = lag(10 ** rng.uniform(-2.5, -1.5), 10 ** rng.uniform(-0.9, -0.3), 10 ** rng.uniform(0.5, 2))
        for _ in range(seed % 5):
            system = system @ lag(1, 10 ** rng.uniform(-0.2, 0.2), 10 ** rng.uniform(0, 2))
        return system

    return ObserverProblem(
        nominal=nominal,
        C=np.eye(4)[:1],
        W_L=block_diagonal([channel(), channel()]),
        W_R=gain(np.diag([1.0, rng.uniform(0.3, 1)]), DT),
        input_scale=np.array([3.0, 3.0]),
        output_scale=np.array([3.0, 3.0, 0.5, 1.0]),
        noise=np.array([1e-5]),
        n_original=3,
        injection=injection,
    )


def main(count: int) -> None:
    """Print one line a problem and the summary."""
    times: list[float] = []
    riccati: list[float] = []
    gaps: list[float] = []
    failures = 0
    for seed in range(count):
        for injection in (Injection.INPUT, Injection.STATE):
            case = problem(seed, injection)
            start = time.perf_counter()
            try:
                one = mixed(case)
            except KrosError as error:
                failures += 1
                print(seed, injection.value, "mixed failed:", error)
                continue
            times.append(time.perf_counter() - start)
            start = time.perf_counter()
            two = worst_case_h2(case)
            total = time.perf_counter() - start
            riccati.append(two.solve_s)
            gaps.append(two.gap_percent or np.nan)
            print(
                f"{seed:3d} {injection.value:5s} states {mixed_plant(case).sizes[0]:2d} | mixed {times[-1]:6.2f} s {one.solver} {one.status.value} "
                f"worst case {one.worst_case_h2:9.4f} | worst_case_h2 {1e3 * two.solve_s:6.2f} ms (with fits {total:5.2f} s) {two.worst_case_h2:9.4f} "
                f"bound {two.lower_bound:9.4f} gap {two.gap_percent:6.2f} %",
                flush=True,
            )
    print(f"mixed: median {np.median(times):.2f} s, worst {max(times):.2f} s, {failures} failures of {2 * count}")
    print(
        f"worst_case_h2: Riccati part median {1e3 * np.median(riccati):.2f} ms, worst {1e3 * max(riccati):.2f} ms; gap median {np.median(gaps):.2f} %"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
