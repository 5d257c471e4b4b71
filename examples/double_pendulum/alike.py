"""How alike the six drives are: peak of the inverse input multiplicative residual, by inputs, regularisation and group.

An uncertain set of this form is well posed where the peak is below 0 dB. Models are those of extended dynamic mode decomposition, with the smallest
coefficient that stabilises all six, times a factor; for every group the nominal drive is the one whose peak is lowest.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kros.core import StateSpace
from kros.core.frequency import log_grid
from kros.data import read, split_episodes
from kros.identify import Factor, combine, edmd, smallest_stabilising_alpha
from kros.identify.factors import lifted_factor, reduce_episode
from kros.lifting import Lifting
from kros.study import load_config
from kros.uncertainty import Form, residual, sigma_max

HERE = Path(__file__).parent
LIFTINGS = {"Koopman": ("sin(position)", "cos(position)"), "linear": ()}
INPUTS = {"command, other joint": 3, "command": 1}
FACTORS = (4.0, 100.0, 1e4)
GROUPS = {"all": "", "shoulders": "shoulder", "elbows": "elbow", "C builds": "C."}
FORM = Form("inverse_input_multiplicative")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--factors", type=float, nargs="+", default=FACTORS)
    options = parser.parse_args()
    if "KROS_DATA" not in os.environ:
        sys.exit("Set KROS_DATA to the folder that holds dfki_double_pendulum; study.toml says where it is published.")
    data = load_config(
        HERE / "study.toml", [f"data.source={Path(os.environ['KROS_DATA']) / 'dfki_double_pendulum'}"]
    ).data
    population = read(data.source, data.reader, mapping=data.csv, prepare=data.prepare)
    sys.stdout.write(
        f"{'':8s} {'inputs':22s} {'factor':>7s} " + " ".join(f"{g:>24s}" for g in GROUPS) + f" {'condition':>10s}\n"
    )
    split = split_episodes(population)
    episodes = {
        unit: [population.read_parts(key) for key in split[unit, "default"].train] for unit in population.unit_ids
    }
    for name, functions in LIFTINGS.items():
        lifting = Lifting(population.states, functions)
        for inputs, count in INPUTS.items():
            factors = factors_of(list(episodes.values()), lifting, count)
            for times in options.factors:
                responses, freqs = scaled(factors, lifting, times, population.sample_period_s)
                cells = [
                    f"{'{:.1f} dB at {:.3g} Hz'.format(*peak(population.unit_ids, responses, freqs, part)):>24s}"
                    for part in GROUPS.values()
                ]
                condition = float(np.median(np.linalg.cond(responses[:, -1])))
                sys.stdout.write(f"{name:8s} {inputs:22s} {times:7g} {' '.join(cells)} {condition:10.0f}\n")


def factors_of(drives: Sequence[Sequence[tuple[np.ndarray, np.ndarray]]], lifting: Lifting, inputs: int) -> Factor:
    """Return what identification needs of all drives, with the first few inputs."""
    reduced = [[reduce_episode(x, np.ascontiguousarray(u[:, :inputs]), lifting) for x, u in own] for own in drives]
    return lifted_factor(Factor.stack([combine(Factor.stack(own)) for own in reduced]), lifting, {}, lifting)


def scaled(factors: Factor, lifting: Lifting, times: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return responses of all drives in units of their ranges, shape (drive, frequency, output, input), and frequencies in Hz."""
    n, size = lifting.n_lifted, factors.peak.max(axis=0)
    models = edmd(factors.R, n, times * smallest_stabilising_alpha([(factors.R, n)]))
    freqs, silent = log_grid(dt, 400), np.zeros((n, models.B.shape[-1]))
    systems = [StateSpace(A, B, np.eye(n), silent, dt) for A, B in zip(models.A, models.B, strict=True)]
    return np.stack([s.frequency_response(freqs) for s in systems]) * size[n:] / size[:n, None], freqs


def peak(drives: Sequence[str], responses: np.ndarray, freqs: np.ndarray, part: str) -> tuple[float, float]:
    """Return the lowest peak over the nominal drives of a group in dB, and its frequency in Hz."""
    group = responses[[i for i, unit in enumerate(drives) if part in unit]]
    largest = [
        sigma_max(residual(FORM, nominal, np.delete(group, i, axis=0))).max(axis=0) for i, nominal in enumerate(group)
    ]
    best = min(largest, key=np.max)
    return float(20 * np.log10(best.max())), float(freqs[best.argmax()])


if __name__ == "__main__":
    main()
