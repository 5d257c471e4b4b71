"""An exported observer on a Cortex-M4F under QEMU: self-test, flash, state, stack and instructions a step.

    make embedded        or        python benchmarks/embedded/measure.py [deployed.json [PARAMETER]]

Needs arm-none-eabi-gcc with newlib and qemu-system-arm (packages of most distributions); says so and ends well where they are missing. Without an observer
it takes an estimator of simulated drives with twelve filters, a sine and a cosine.
A parameter is followed by a phase-locked loop.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from kros.data import EpisodeBatch
from kros.export.c99.board import OnBoard, missing_tools
from kros.export.c99.write import c_files
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Observer, Recordings, Seen, identify_estimator
from kros.plants import HarmonicDrivePopulation


def main() -> None:
    """Measure both precisions and print a table."""
    if missing := missing_tools():
        print(
            f"skipped: {', '.join(missing)} not found; install gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm"
        )
        return
    observer, track = (
        Observer.load(sys.argv[1]) if len(sys.argv) > 1 else estimator(),
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


def estimator() -> Observer:
    """Return the estimator of two simulated drives."""
    drives = HarmonicDrivePopulation(2, 2, 2.0).simulate().population
    phases = {unit: {"phase": 0.3} for unit in drives.unit_ids}
    recordings = Recordings.of(list(drives.keys()), lambda key: EpisodeBatch.read(drives, [key], None, phases))
    lifting, settings = Lifting(drives.states, ("sin(100*position + phase)",), ("phase",)), EstimatorSettings(order=12)
    found = identify_estimator(
        "estimator", lifting, (0,), drives.inputs, recordings, drives.sample_period_s, {"phase": 0.3}, settings
    )
    return replace(found.observer, seen=Seen(np.array([6.3]), np.array([6.3, 3.2])))


if __name__ == "__main__":
    main()
