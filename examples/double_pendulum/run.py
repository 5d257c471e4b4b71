"""Run `study.toml` on the measured recordings: `dfki_double_pendulum` in the folder of the environment variable KROS_DATA."""

import os
import sys
from pathlib import Path

from kros.cli import app

if __name__ == "__main__":
    here = Path(__file__).parent
    if "KROS_DATA" not in os.environ:
        sys.exit("Set KROS_DATA to the folder that holds dfki_double_pendulum; study.toml says where it is published.")
    source = Path(os.environ["KROS_DATA"]) / "dfki_double_pendulum"
    app(["run", str(here / "study.toml"), "--set", f"data.source={source}", "--until", "report", *sys.argv[1:]])
