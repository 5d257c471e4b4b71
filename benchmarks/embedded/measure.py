"""An exported observer on a Cortex-M4F under QEMU: self-test, flash, state, stack and instructions a step.

    make embedded        or        python benchmarks/embedded/measure.py [deployed.json]

Needs arm-none-eabi-gcc with newlib and qemu-system-arm (packages of most distributions); says so and ends well where they are missing. Without an observer
it takes one of the shape of a drive's subspace-identified predictor: fifteen states, twelve of them its own, a sine and a cosine.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from kros.core.lti import StateSpace
from kros.export import export_c
from kros.lifting import Lifting
from kros.observer import Observer, Seen
from kros.synthesis import Injection

HOME = Path(__file__).parent
BOARD = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-ffunction-sections", "-fdata-sections", "-std=c99")
TOOLS = ("arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")


def main() -> None:
    """Measure both precisions and print a table."""
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        print(f"skipped: {', '.join(missing)} not found; install gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm")
        return
    observer = Observer.load(sys.argv[1]) if len(sys.argv) > 1 else predictor()
    print(f"{observer!r}\n{'build':<12}{'flash':>8}{'state':>7}{'stack':>7}{'instructions a step':>21}")
    for precision in ("float", "double"):
        for level in ("-O2", "-Os"):
            found = measured(observer, precision, level)
            print(
                f"{precision + ' ' + level:<12}{found['flash']:>8}{found['state_bytes']:>7}{found['stack']:>7}{found['instructions_a_step']:>21}"
            )
            if found["selftest"]:
                raise SystemExit("the self-test failed on the board")


def measured(observer: Observer, precision: str, level: str) -> dict[str, int]:
    """Return bytes of flash (the observer's own), state and stack, and instructions a step."""
    with tempfile.TemporaryDirectory() as name:
        folder = export_c(observer, Path(name) / "c", "observer", precision)
        run("arm-none-eabi-gcc", *BOARD, level, "-fstack-usage", "-c", "observer.c", "-o", "observer.o", cwd=folder)
        flash = int(run("arm-none-eabi-size", "observer.o", cwd=folder).splitlines()[1].split()[0])
        frames = {line.split()[0].rpartition(":")[2]: int(line.split()[1]) for line in (folder / "observer.su").read_text().splitlines()}
        linked = (
            "-T",
            str(HOME / "board.ld"),
            "-nostartfiles",
            "--specs=nano.specs",
            "--specs=nosys.specs",
            "-Wl,--gc-sections",
            "-lm",
            "-o",
            "board.elf",
        )
        sources = (str(HOME / "board.c"), "observer.c", "observer_selftest.c")
        run("arm-none-eabi-gcc", *BOARD, level, "-I.", *sources, *linked, cwd=folder)
        board = ("-M", "mps2-an386", "-nographic", "-semihosting", "-icount", "shift=0", "-kernel", "board.elf")
        said = run("qemu-system-arm", *board, cwd=folder)
    return {"flash": flash, "stack": sum(frames.values()), **{key: int(value) for key, value in re.findall(r"(\w+) (\d+)", said)}}


def run(*command: str, cwd: Path) -> str:
    """Run a command, return what it printed."""
    done = subprocess.run(command, cwd=cwd, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")
    return done.stdout + done.stderr


def predictor() -> Observer:
    """Return an observer of the size of a drive's predictor."""
    rng, n, own = np.random.default_rng(3), 15, [f"memory_{i + 1}" for i in range(12)]
    lifting = Lifting(("position", "velocity", "current", *own), ("sin(100*position + phase)", "cos(100*position + phase)"), ("phase",))
    A = np.zeros((17, 17))
    A[:n, :n], A[:n, n:] = 0.05 * rng.normal(size=(n, n)) + 0.7 * np.eye(n), 1e-3 * rng.normal(size=(n, 2))
    A[:n, 0], A[0, 0] = 0.1 * A[:n, 0], 1.0
    B = np.vstack([0.01 * rng.normal(size=(n, 2)), np.zeros((2, 2))])
    gain = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((17, 0)), A[:, :1], 1e-3)
    seen, inputs = Seen(np.array([6.3]), np.array([6.3, 3.2])), ("target_position", "target_velocity")
    return Observer(
        "predictor", lifting, A, B, (0,), inputs, gain, Injection.STATE, 1e-3, {"phase": 0.3}, seen=seen, replaces=True, internal=12
    )


if __name__ == "__main__":
    main()
