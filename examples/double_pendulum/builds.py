"""Predict 0.2 s of three measured double pendulums: one Koopman model a build, refined per design, against linear ARX models.

q1, q2, w1, w2 : angles and rates of the joints
held1, held2   : torques commanded one sample ago; known at run time, and states here so that formulas may read them
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

import numpy as np

import kros
from kros.data import Channel, EpisodeKey, Population, Role
from kros.identify import KoopmanMatrices, edmd, free_run, smallest_stabilising_alpha, unit_factors
from kros.identify.refine import RefineOptions, refine_population
from kros.lifting import Lifting

PERIOD_S = 0.0025
HORIZON = 80
HELD_OUT = {"A.0": ("01", "03"), "C.0": ("01", "03"), "C.1": ("143524", "143704")}
SPIKES = {"C.0": ("12", "13")}  # saturation and velocity spikes
DESIGNS = (("A.0",), ("C.0", "C.1"))  # links of 0.3 m and 0.2 m, and of 0.2 m and 0.3 m
SPANS = {"all samples up to 0.2 s": slice(None), "the sample at 0.2 s": slice(-1, None)}
PIECE = 200  # samples: half a second; over a whole swing-up no model stays with the recording

STATES = ("q1", "q2", "w1", "w2", "held1", "held2")
GRAVITY = ("sin(q1)", "sin(q1 + q2)")
FRICTION = ("tanh(10*w1)", "tanh(10*w2)")
INERTIAL = ("sin(q2)*w1**2", "sin(q2)*w2**2", "sin(q2)*w1*w2")
COUPLED = tuple(f"cos(q2)*{f}" for f in (*GRAVITY, "held1", "held2"))
LIFTING = Lifting(STATES, GRAVITY + FRICTION + INERTIAL + COUPLED)
OPTIONS = RefineOptions(
    horizons=(5, 20, HORIZON), segments=150, pooled_segments=150, balance=0.5, strengths=(10.0,), bound=1e3
)

Recordings = dict[str, dict[str, np.ndarray]]


def read(folder: Path, spikes: bool) -> Recordings:
    """Return episodes by build, columns q1 q2 w1 w2 held1 held2 command1 command2, 400 samples a second."""
    # 800 samples a second are more than were recorded, so this only interpolates; every second one is kept
    even = kros.data.steps.Resample(0.00125)
    population = kros.read(folder, mapping=Path(__file__).parent / "builds.toml", prepare=[even])
    found: Recordings = {}
    for key in population.episodes:
        if spikes or key.episode not in SPIKES.get(key.unit, ()):
            values = population.read(key)[::2]
            held = values[:-1, 4:]
            found.setdefault(key.unit, {})[key.episode] = np.concatenate([values[1:, :4], held, values[1:, 4:]], axis=1)
    return found


def training(recordings: Recordings, design: tuple[str, ...]) -> Population:
    """Return the training episodes of a design, cut to pieces of about half a second in which all states move."""
    pieces = {}
    for build in design:
        for name, values in recordings[build].items():
            if name not in HELD_OUT[build]:
                split = np.array_split(values, len(values) // PIECE)
                for i, piece in enumerate(piece for piece in split if np.ptp(piece[:, : len(STATES)], axis=0).all()):
                    pieces[EpisodeKey(build, "default", f"{name}-{i:02d}")] = piece
    channels = [Channel(name, Role.STATE, measured=True) for name in STATES]
    channels += [Channel(name, Role.INPUT) for name in ("command1", "command2")]
    return kros.from_arrays(pieces, channels, PERIOD_S)


def fit(population: Population) -> dict[str, KoopmanMatrices]:
    """Fit the builds of one design: by least squares, and refined on free runs, all together first, then each with a prior."""
    keys = {unit: population.keys(unit) for unit in population.unit_ids}
    factor = unit_factors(population, keys, LIFTING)
    alpha = 4 * smallest_stabilising_alpha([(factor.R, LIFTING.n_lifted)])
    refined = refine_population(population, keys, LIFTING, {}, factor, options=OPTIONS)
    return {"refined": refined, "EDMD": edmd(factor.R, LIFTING.n_lifted, alpha)}


def windows(values: np.ndarray) -> np.ndarray:
    """Return every stretch of 81 samples with one sample before it, shape (start, 81, column)."""
    return np.swapaxes(np.lib.stride_tricks.sliding_window_view(values[1:], HORIZON + 1, axis=0), 1, 2)


def koopman_predictions(A: np.ndarray, B: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Predict q1 q2 w1 w2 of steps 1 to 80 from every sample, shape (start, 80, 4)."""
    part = windows(values)
    return free_run(A, B, LIFTING, {}, part[:, 0, :6], part[:, :, 6:])[:, 1:, :4]


def arx_outputs(values: np.ndarray) -> np.ndarray:
    """Return sin q1, sin(q1 + q2), q1, q2, w1, w2."""
    return np.concatenate(
        [np.sin(values[..., :1]), np.sin(values[..., :1] + values[..., 1:2]), values[..., :4]], axis=-1
    )


def fit_arx(episodes: list[np.ndarray]) -> np.ndarray:
    """Fit outputs to two samples of the outputs and of the commands, shape (16, 6)."""
    rows = [(arx_outputs(v), v[:, 6:]) for v in episodes]
    past = np.concatenate([np.concatenate([y[1:-1], y[:-2], u[1:-1], u[:-2]], axis=1) for y, u in rows])
    return np.linalg.lstsq(past, np.concatenate([y[2:] for y, _ in rows]), rcond=None)[0]


def arx_predictions(arx: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Predict q1 q2 w1 w2 of steps 1 to 80 from every sample and the one before, shape (start, 80, 4)."""
    part = windows(values)
    now, before = arx_outputs(part[:, 0]), arx_outputs(values[: len(part)])
    out = np.empty((len(part), HORIZON, 4))
    for step in range(HORIZON):
        held, command = part[:, step, 4:6], part[:, step, 6:]
        now, before = np.concatenate([now, before, command, held], axis=1) @ arx, now
        out[:, step] = now[:, 2:]
    return out


def r2(predicted: list[np.ndarray], values: list[np.ndarray], steps: slice) -> np.ndarray:
    """Return R^2 over both held-out episodes, all starts and the given steps, for q1, q2, w1, w2."""
    p = np.concatenate([x[:, steps].reshape(-1, 4) for x in predicted])
    t = np.concatenate([windows(v)[:, 1:, :4][:, steps].reshape(-1, 4) for v in values])
    with np.errstate(over="ignore", invalid="ignore"):  # a model that diverges
        return 1 - np.sum((p - t) ** 2, axis=0) / np.sum((t - t.mean(axis=0)) ** 2, axis=0)


def compare(recordings: Recordings) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """Return R^2 by span of steps, build and model."""
    found: dict[str, dict[str, dict[str, np.ndarray]]] = {title: {} for title in SPANS}
    for design in DESIGNS:
        models = fit(training(recordings, design))
        for row, build in enumerate(design):
            held_out = [recordings[build][name] for name in HELD_OUT[build]]
            arx = fit_arx([v for name, v in recordings[build].items() if name not in HELD_OUT[build]])
            runs = {name: [koopman_predictions(m.A[row], m.B[row], v) for v in held_out] for name, m in models.items()}
            runs["ARX"] = [arx_predictions(arx, v) for v in held_out]
            for title, steps in SPANS.items():
                found[title][build] = {name: r2(predicted, held_out, steps) for name, predicted in runs.items()}
    return found


def main() -> None:
    """Print R^2 of every joint."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--with-spikes", action="store_true", help="train on the two episodes of C.0 with velocity spikes, too"
    )
    parser.add_argument("--json", action="store_true", help="print numbers for other programs")
    arguments = parser.parse_args()
    if "KROS_DATA" not in os.environ:
        sys.exit("Set KROS_DATA to the folder that holds dfki_double_pendulum; study.toml says where it is published.")
    found = compare(read(Path(os.environ["KROS_DATA"]) / "dfki_double_pendulum", arguments.with_spikes))
    if arguments.json:
        print(
            json.dumps(
                {
                    t: {b: {n: v.tolist() for n, v in models.items()} for b, models in rows.items()}
                    for t, rows in found.items()
                }
            )
        )
        return
    for title, rows in found.items():
        print(f"R^2 over {title}\nbuild  model    " + "".join(f"{s:>8}" for s in STATES[:4]))
        for build, models in rows.items():
            for name, values in models.items():
                print(f"{build:6} {name:8} " + "".join(f"{v:8.3f}" for v in values))
        for name in ("refined", "EDMD", "ARX"):
            print(
                f"velocity, mean over the six drives, {name}: {np.mean([models[name][2:] for models in rows.values()]):.3f}"
            )


if __name__ == "__main__":
    main()
