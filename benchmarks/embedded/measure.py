"""An exported observer on a Cortex-M4F under QEMU: self-test, flash, state, stack and instructions a step.

    make embedded        or        python benchmarks/embedded/measure.py [deployed.json [PARAMETER]]

Needs arm-none-eabi-gcc with newlib and qemu-system-arm (packages of most distributions); says so and ends well where they are missing. Without an observer
it takes one of the shape of a drive's subspace-identified predictor: fifteen states, twelve of them its own, a sine and a cosine.
A parameter is followed by a phase-locked loop.
"""

from __future__ import annotations

import sys

import numpy as np

from kros.core.lti import StateSpace
from kros.export.c99.board import OnBoard, missing_tools
from kros.export.c99.write import c_files
from kros.lifting import Lifting
from kros.observer import Observer, Seen
from kros.synthesis import Injection


def main() -> None:
    """Measure both precisions and print a table."""
    if missing := missing_tools():
        print(
            f"skipped: {', '.join(missing)} not found; install gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm"
        )
        return
    observer, track = (
        Observer.load(sys.argv[1]) if len(sys.argv) > 1 else predictor(),
        sys.argv[2] if len(sys.argv) > 2 else None,
    )
    print(f"{observer!r}\n{'build':<12}{'flash':>8}{'state':>7}{'stack':>7}{'instructions a step':>21}")
    for precision in ("float", "double"):
        files = c_files(observer, "observer", precision, track)
        for level in ("-O2", "-Os"):
            found = OnBoard.of(files, "observer", level)
            print(
                f"{precision + ' ' + level:<12}{found.flash:>8}{found.state:>7}{found.stack:>7}{found.instructions_a_step:>21}"
            )
            if found.selftest:
                raise SystemExit("the self-test failed on the board")


def predictor() -> Observer:
    """Return an observer of the size of a drive's predictor."""
    rng, n, own = np.random.default_rng(3), 15, [f"memory_{i + 1}" for i in range(12)]
    lifting = Lifting(
        ("position", "velocity", "current", *own),
        ("sin(100*position + phase)", "cos(100*position + phase)"),
        ("phase",),
    )
    A = np.zeros((17, 17))
    A[:n, :n], A[:n, n:] = 0.05 * rng.normal(size=(n, n)) + 0.7 * np.eye(n), 1e-3 * rng.normal(size=(n, 2))
    A[:n, 0], A[0, 0] = 0.1 * A[:n, 0], 1.0
    B = np.vstack([0.01 * rng.normal(size=(n, 2)), np.zeros((2, 2))])
    gain = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((17, 0)), A[:, :1], 1e-3)
    seen, inputs = Seen(np.array([6.3]), np.array([6.3, 3.2])), ("target_position", "target_velocity")
    return Observer(
        "predictor",
        lifting,
        A,
        B,
        (0,),
        inputs,
        gain,
        Injection.STATE,
        1e-3,
        {"phase": 0.3},
        seen=seen,
        replaces=True,
        internal=12,
    )


if __name__ == "__main__":
    main()
