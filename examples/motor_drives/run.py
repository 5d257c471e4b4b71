"""Run the paper's study on the published recordings (`--recordings` names their folder) or on simulated drives.

Options that are not listed are passed to `kros run`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from kros.cli import app

HERE = Path(__file__).parent


def call(*arguments: object) -> None:
    """Call the command line, and end with its exit code if it fails."""
    if code := app([str(argument) for argument in arguments], standalone_mode=False):
        sys.exit(code)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/motor_drives"))
    parser.add_argument("--recordings", type=Path, help="folder that holds batch_b")
    parser.add_argument("--units", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=10, help="of each condition; the paper has 20")
    parser.add_argument("--seconds", type=float, default=20.0)
    chosen, options = parser.parse_known_args()
    recordings = chosen.recordings or chosen.out.with_name(f"{chosen.out.name}-recordings")
    if chosen.recordings is None and not recordings.exists():
        size = ("--units", chosen.units, "--episodes", chosen.episodes, "--seconds", chosen.seconds)
        call("simulate", recordings, *size, "--outlier", "--format", "raw")
    call("run", HERE / "study.toml", "--out", chosen.out, "--set", f"data.source={recordings.resolve()}", *options)
