"""Judge a controller that uses the estimates of a run's observer.

    python run.py RUN --controller damper.json [--observer koopman/estimator] [--json]

Exit status 0 if the loop is SAFE, 1 if it is NOT SAFE or UNDECIDED, 2 for bad input.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from controller import Controller
from loop import close_loop

from kros.core.artifacts import plain, read_json
from kros.core.errors import KrosError
from kros.observer import Observer
from kros.uncertainty.quantify import UncertainModels


def main(arguments: list[str]) -> int:
    """Print the verdict and its reasons."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--controller", type=Path, required=True, help="state space as JSON")
    parser.add_argument("--observer", default="deployed")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    try:
        controller = Controller.of(read_json(options.controller), f"Controller {options.controller}")
        observer = Observer.load(options.run / "observers" / f"{options.observer}.json")
        result = close_loop(observer, UncertainModels.load(options.run), controller)
    except KrosError as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(plain(vars(result)), indent=1) if options.json else "\n".join(result.lines()))
    return 0 if result.safe else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
