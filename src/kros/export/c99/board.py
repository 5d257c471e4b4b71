"""Generated code on a Cortex-M4F under QEMU: the self-test's answer, flash, state, stack and instructions a step."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ...core.errors import ConfigError
from ...loops.compiler import run_tool

TOOLS = ("arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")
_HOME = Path(__file__).parent / "board"
_PROCESSOR = (
    "-mcpu=cortex-m4",
    "-mthumb",
    "-mfpu=fpv4-sp-d16",
    "-mfloat-abi=hard",
    "-ffunction-sections",
    "-fdata-sections",
    "-std=c99",
)
_LINKED = (
    "-T",
    str(_HOME / "board.ld"),
    "-nostartfiles",
    "--specs=nano.specs",
    "--specs=nosys.specs",
    "-Wl,--gc-sections",
    "-lm",
)
_BOARD = (
    "qemu-system-arm",
    "-M",
    "mps2-an386",
    "-nographic",
    "-semihosting",
    "-icount",
    "shift=0",
    "-kernel",
    "board.elf",
)


@dataclass(frozen=True)
class OnBoard:
    """What an observer costs on a board."""

    flash: int
    state: int
    stack: int
    instructions_a_step: int
    selftest: int

    @classmethod
    def of(cls, files: Mapping[str, str], name: str, level: str = "-O2") -> OnBoard:
        """Compile the files of an export and run them."""
        if missing := missing_tools():
            raise ConfigError(
                f"Measuring on a board: {', '.join(missing)} not found; install gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm."
            )
        with TemporaryDirectory() as folder:
            for file, text in files.items():
                Path(folder, file).write_text(text)
            _run("arm-none-eabi-gcc", *_PROCESSOR, level, "-fstack-usage", "-c", f"{name}.c", "-o", "own.o", cwd=folder)
            flash = int(_run("arm-none-eabi-size", "own.o", cwd=folder).splitlines()[1].split()[0])
            frames = {
                row.split()[0].rpartition(":")[2]: int(row.split()[1])
                for row in Path(folder, "own.su").read_text().splitlines()
            }
            known = (f"-DNAME={name}", f"-DUPPER={name.upper()}", f'-DHEADER="{name}.h"', "-I.")
            sources = (str(_HOME / "board.c"), f"{name}.c", f"{name}_selftest.c")
            _run("arm-none-eabi-gcc", *_PROCESSOR, level, *known, *sources, *_LINKED, "-o", "board.elf", cwd=folder)
            said = dict(re.findall(r"(\w+) (\d+)", _run(*_BOARD, cwd=folder)))
        return cls(
            flash,
            int(said["state_bytes"]),
            sum(frames.values()),
            int(said["instructions_a_step"]),
            int(said["selftest"]),
        )


def missing_tools() -> list[str]:
    """Return which tools are not on the PATH."""
    return [tool for tool in TOOLS if shutil.which(tool) is None]


def _run(*command: str, cwd: str) -> str:
    try:
        return run_tool(command, cwd=cwd)
    except (OSError, subprocess.SubprocessError) as error:
        raise ConfigError(f"Measuring on a board: {error}; repair the tools, or take them off the PATH.") from error
