"""Robust output feedback for a batch of pendulums: kros quantifies their differences, dkpy (where installed) designs one controller for all.

    python examples/output_feedback/run.py --out runs/output_feedback

Prints the measured numbers as JSON; writes `metrics.json` into the folder.
"""

import argparse
import json
import sys
from pathlib import Path

import control
import numpy as np

import kros
from kros.core import StateSpace
from kros.core.norms import to_continuous
from kros.interop.control import from_control, to_control
from kros.plants import PendulumPopulation
from kros.synthesis import h2, hinf
from kros.synthesis.generalized_plant import interconnect, split
from kros.uncertainty import quantify

DT, REFERENCE_RAD = 0.01, 0.25
GRID_RAD = np.tan(np.pi * DT * np.geomspace(0.01, 45.0, 30))  # of the plant in continuous time, z = (1 + s) / (1 - s)
SENSITIVITY, TORQUE = (10.0, 0.4, 0.05), (0.05, 0.4, 15.0)  # gain at zero frequency and at Nyquist, corner in Hz


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/output_feedback"))
    parser.add_argument("--units", type=int, default=10)
    options = parser.parse_args()
    simulated = PendulumPopulation(options.units, 10, 20.0, 1, 1.0).simulate()
    uncertain = quantify(identify(simulated.population), "additive", np.geomspace(1e-3, 50.0, 300))
    plant = generalized_plant(uncertain)
    controllers = {
        "nominal H2": h2(plant.channel(slice(1, None), slice(1, None))).controller,
        "H-infinity": hinf(plant).controller,
    }
    facts = {"units": options.units, "cover_max": round(uncertain.cover_max, 4)}
    try:
        controllers["D-K iteration"], facts["mu"] = dk_iteration(plant)
    except ImportError as missing:
        print(f"D-K iteration is left out: {missing.name} is not installed (pip install dkpy).", file=sys.stderr)
    for name, K in controllers.items():
        closed = to_control(plant.close(K))
        facts[name] = {
            "order": K.n_states,
            "small_gain": round(float(control.norm(closed[0, 0], "inf")), 3),
            "norm": round(float(control.norm(closed, "inf")), 3),
            **judged(*simulate(simulated.truth, K)),
        }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "metrics.json").write_text(json.dumps(facts, indent=1))
    print(json.dumps(facts, indent=1))


def identify(population):
    """One Koopman model with the sine of the angle a unit, from torque to position."""
    models = kros.identify(population, lifting=["sin(position)"], refine=False).models("koopman_edmd")
    C = np.eye(1, models.A.shape[1])
    return [StateSpace(A, B, C, np.zeros((1, 1)), DT) for A, B in zip(models.A, models.B, strict=True)]


def generalized_plant(uncertain):
    """``u -> G``, with ``W_L Delta W_R`` beside it; W_S weighs position minus reference, W_U the torque; the controller sees the noisy error."""
    one, size = np.eye(1), float(REFERENCE_RAD / uncertain.output_scale[0])
    weights = {
        "W_L": uncertain.weight.left,
        "W_R": uncertain.weight.right,
        "W_S": lag(*SENSITIVITY),
        "W_U": lag(*TORQUE),
    }
    error = {"G": one, "W_L": one, "reference": -size * one}
    scaled = {name: matrix / size for name, matrix in error.items()}
    wires = {"G": {"u": one}, "W_L": {"w": one}, "W_R": {"u": one}, "W_S": scaled, "W_U": {"u": one}}
    outputs = {"z": {"W_R": one}, "z1": {"W_S": one}, "z2": {"W_U": one}, "y": {**error, "noise": 0.01 * size * one}}
    blocks, inputs = {"G": uncertain.scaled_nominal(), **weights}, {"w": 1, "reference": 1, "noise": 1, "u": 1}
    return split(interconnect(blocks, wires, inputs, outputs), 3, 3, n_w1=1, n_z1=1)


def lag(low, high, corner_hz):
    """First-order weight with the gain `low` at zero frequency and `high` at Nyquist."""
    a = np.exp(-2 * np.pi * corner_hz * DT)
    d, c = np.linalg.solve([[1, 1 / (1 - a)], [1, -1 / (1 + a)]], [low, high])
    return StateSpace([[a]], [[1.0]], [[c]], [[d]], DT)


def dk_iteration(plant):
    """Controller of dkpy's D-K iteration with kros's H-infinity synthesis in it, and the peak of mu on the grid."""
    import dkpy

    class Synthesis(dkpy.ControllerSynthesis):
        def synthesize(self, P, n_y, n_u):
            K = to_control(hinf(split(from_control(P), P.ninputs - n_u, P.noutputs - n_y)).controller)
            return K, P.lft(K), None, {}

    mu = dkpy.SsvLmiBisection(n_jobs=None, bisection_rtol=1e-3)
    iteration = dkpy.DkIterFixedOrder(Synthesis(), mu, dkpy.DScaleFitSlicot(), n_iterations=3, fit_order=2)
    blocks = [dkpy.ComplexFullBlock(1, 1), dkpy.ComplexFullBlock(2, 2)]
    K, _, peak, *_ = iteration.synthesize(to_control(to_continuous(plant.open_loop())), 1, 1, GRID_RAD, blocks)
    K = control.sample_system(K, 2.0, "tustin")
    return StateSpace(K.A, K.B, K.C, K.D, DT), round(float(peak), 3)


def simulate(truth, K, seconds=8.0, substeps=4, count=2 * np.pi / 4096):
    """Positions and torques (sample, unit) of all nonlinear pendulums at steps of the reference."""
    units, h = len(truth.unit_ids), DT / substeps
    x, k, positions, torques = np.zeros((2, units)), np.zeros((K.n_states, units)), [], []
    for i in range(round(seconds / DT)):
        error = np.rint(x[:1] / count) * count - (REFERENCE_RAD if i * DT < seconds / 2 else -REFERENCE_RAD)
        torque = np.clip(K.C @ k + K.D @ error, -20, 20)[0]
        k = K.A @ k + K.B @ error
        positions.append(x[0])
        torques.append(torque)
        for _ in range(substeps):
            middle = x + h / 2 * truth.rates(x[..., None], torque[:, None])[..., 0]
            x = x + h * truth.rates(middle[..., None], torque[:, None])[..., 0]
    return np.array(positions), np.array(torques)


def judged(positions, torques):
    """Settled error from 1.5 s after a step and overshoot, in percent of the step, of the worst unit; largest torque."""
    times = np.arange(len(positions)) * DT
    error = (positions - np.where(times < 4.0, REFERENCE_RAD, -REFERENCE_RAD)[:, None]) / REFERENCE_RAD
    settled = np.sqrt(np.mean(error[times % 4.0 >= 1.5] ** 2, axis=0))
    numbers = {"settled_error_percent": 100 * settled.max(), "overshoot_percent": 100 * error[times < 4.0].max()}
    return {name: round(float(value), 1) for name, value in numbers.items()} | {
        "largest_torque": round(float(np.abs(torques).max()), 2)
    }


if __name__ == "__main__":
    main()
