"""How few states a worst-case H2 observer needs: order reduction and polish on the models of finished runs.

    kros simulate RECORDINGS --units 8 --episodes 6 --seed 10 --loop soft --spread 3
    kros run study.toml --until quantify --out RUN
    python benchmarks/reduction.py RUN [RUN ...]

Prints one JSON line for every model and injection: certified worst-case H2 of the full design, and in percent of it what the lowest order within 2 %, six
states, and both after polish change.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from kros.core import SynthesisError
from kros.core.artifacts import load_artifact
from kros.identify import ModelSet
from kros.synthesis import Injection, ObserverProblem, Synthesis, polish, reduce_controller, worst_case_h2
from kros.uncertainty import UncertainModel


def main() -> None:
    """Reduce the observers of all runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--models", nargs="+", default=["koopman", "koopman_edmd"])
    options = parser.parse_args()
    for run in options.runs:
        for model in options.models:
            for injection in (Injection.STATE, Injection.INPUT):
                row = {"run": str(run), "model": model, "injection": injection.value, **facts(run, model, injection)}
                sys.stdout.write(json.dumps(row) + "\n")
                sys.stdout.flush()


def facts(run: Path, model: str, injection: Injection) -> dict[str, Any]:
    """Return orders, losses and times of one observer."""
    problem = read_problem(run, model, injection)
    try:
        full = worst_case_h2(problem)
    except SynthesisError as error:
        return {"refused": str(error)}

    def timed(function: Any, *arguments: Any, **options: Any) -> tuple[Synthesis, float]:
        start = time.process_time()
        return function(*arguments, **options), round(time.process_time() - start, 2)

    lowest, lowest_s = timed(reduce_controller, problem, full)
    six, six_s = timed(reduce_controller, problem, full, order=6)
    found: dict[str, Any] = {"order": full.controller.n_states, "worst_case_h2": full.worst_case_h2, "lower_bound": full.lower_bound}
    designs = {"lowest": (lowest, lowest_s), "lowest_polished": timed(polish, problem, lowest)}
    designs |= {"six": (six, six_s), "six_polished": timed(polish, problem, six)}
    for name, (design, seconds) in designs.items():
        change = 100 * ((design.worst_case_h2 or np.inf) / (full.worst_case_h2 or np.nan) - 1)
        found[name] = {"order": design.controller.n_states, "change_percent": round(change, 3), "seconds": seconds}
    return found


def read_problem(run: Path, model: str, injection: Injection) -> ObserverProblem:
    """Return the observer problem of a run's models, with the noise of the encoder."""
    models, uncertain = ModelSet.load(run / "models" / model), UncertainModel.load(run / "uncertainty" / model)
    unit = load_artifact(run / "uncertainty", "choice")[0]["nominal"]
    resolution = load_artifact(run / "population", "facts")[0]["resolution"]
    remainder = uncertain.remainder
    return ObserverProblem(
        nominal=models.systems([unit])[0],
        C=np.eye(models.lifting.n_lifted)[list(models.measured)],
        W_L=uncertain.weight.left,
        W_R=uncertain.weight.right,
        input_scale=models.input_scale,
        output_scale=models.output_scale,
        noise=np.array([resolution[models.lifting.states[i]] / np.sqrt(12) for i in models.measured]),
        n_original=models.lifting.n_states,
        remainder_left=remainder.left if remainder is not None else None,
        remainder_right=remainder.right if remainder is not None else None,
        injection=injection,
    )


if __name__ == "__main__":
    main()
