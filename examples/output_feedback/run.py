"""Robust output feedback for a batch of pendulums: identify every unit, quantify their differences, design one controller, try it on all.

    python examples/output_feedback/run.py --out runs/output_feedback

Prints the measured numbers as JSON; writes `metrics.json` and `step.svg` into the folder.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from kros.core import StateSpace, hinf_norm
from kros.interop import KoopmanRegressor
from kros.plants import PendulumPopulation
from kros.synthesis import Block, GeneralizedPlant, dk_iteration, h2, mu_bounds, reduce_controller
from kros.synthesis.problem.interconnect import interconnect
from kros.uncertainty import quantify_systems

DT, REFERENCE_RAD = 0.01, 0.25
GRID_HZ = np.geomspace(0.002, 49.0, 50)
SENSITIVITY, TORQUE = (10.0, 0.4, 0.05), (0.05, 0.4, 15.0)  # gain at zero frequency and at Nyquist, corner in Hz
PERFORMANCE = [Block.full(2, 2)]


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/output_feedback"))
    parser.add_argument("--units", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--spread", type=float, default=1.0)
    parser.add_argument("--iterations", type=int, default=3, help="of the D-K iteration")
    options = parser.parse_args()
    simulated = PendulumPopulation(options.units, 10, 20.0, options.seed, options.spread).simulate()
    models = identify(simulated.population)
    uncertain = quantify_systems(models, "additive", np.geomspace(1e-3, 50.0, 300))
    facts = {
        "units": options.units,
        "uncertainty": {"peak_db": round(uncertain.peak_db[uncertain.form], 2), "cover_max": round(uncertain.cover_max, 4)},
    }
    plant, blocks = generalized_plant(uncertain), [Block.full(1), *PERFORMANCE]
    robust = dk_iteration(plant, blocks, iterations=options.iterations, freqs_hz=GRID_HZ)
    small = reduce_controller(plant, robust, 8)
    nominal = h2(part(plant, 1))
    designs = {"nominal H2": nominal, "robust": robust, "robust, reduced": small}
    responses = {}
    for name, design in designs.items():
        closed = plant.close(design.controller)
        bounds = mu_bounds(closed, blocks, GRID_HZ)
        responses[name] = simulate(simulated.truth, design.controller)
        facts[name] = {
            "order": design.controller.n_states,
            "mu": [round(bounds.peak_lower, 3), round(bounds.peak, 3)],
            "small_gain": round(hinf_norm(channel(closed, 0, 0)), 3),
            **judged(responses[name]),
        }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "metrics.json").write_text(json.dumps(facts, indent=1))
    draw(responses, options.out / "step.svg")
    print(json.dumps(facts, indent=1))


def identify(population):
    """One Koopman model with the sine of the angle a unit, from torque to position."""
    systems = []
    for unit in population.unit_ids:
        rows = [np.hstack([np.full((len(x), 1), i), x]) for i, x in enumerate(population.read(k) for k in population.keys(unit))]
        model = KoopmanRegressor(["sin(x0)"], n_inputs=1, episode_feature=True).fit(np.vstack(rows)).system(DT)
        systems.append(StateSpace(model.A, model.B, model.C[:1], model.D[:1], DT))
    return systems


def generalized_plant(uncertain):
    """Interconnection of the uncertain model and the weights.

    ::

                +-> W_R -> z ..Delta.. w -> W_L -+              reference
                |                                v                  |
        u ------+-> G ------------------------->(+)-> position -->( - )-+-> W_S -> z_1,     u -> W_U -> z_2
                                                                        |
                                                            noise ---->(+)-> y, to the controller
    """
    one = np.eye(1)
    blocks = {
        "G": uncertain.scaled_nominal(),
        "W_L": uncertain.weight.left,
        "W_R": uncertain.weight.right,
        "W_S": lag(*SENSITIVITY),
        "W_U": lag(*TORQUE),
    }
    size = float(REFERENCE_RAD / uncertain.output_scale[0])
    tracking = {"G": one, "W_L": one, "reference": -size * one}
    wires = {
        "G": {"u": one},
        "W_L": {"w": one},
        "W_R": {"u": one},
        "W_S": {name: matrix / size for name, matrix in tracking.items()},
        "W_U": {"u": one},
    }
    outputs = {"z": {"W_R": one}, "z1": {"W_S": one}, "z2": {"W_U": one}, "y": {**tracking, "noise": 0.01 * size * one}}
    system = interconnect(blocks, wires, {"w": 1, "reference": 1, "noise": 1, "u": 1}, outputs)
    B, C, D = system.B, system.C, system.D
    return GeneralizedPlant(system.A, B[:, :3], B[:, 3:], C[:3], C[3:], D[:3, :3], D[:3, 3:], D[3:, :3], D[3:, 3:], DT, n_w1=1, n_z1=1)


def lag(low, high, corner_hz):
    """First-order weight with the gain `low` at zero frequency and `high` at Nyquist."""
    a = np.exp(-2 * np.pi * corner_hz * DT)
    d, c = np.linalg.solve([[1, 1 / (1 - a)], [1, -1 / (1 + a)]], [low, high])
    return StateSpace([[a]], [[1.0]], [[c]], [[d]], DT)


def part(plant, skipped):
    """The plant without its first `skipped` disturbances and outputs: performance alone."""
    return plant.channel(slice(skipped, None), slice(skipped, None))


def channel(system, row, column):
    """One entry of a system."""
    rows, columns = slice(row, row + 1), slice(column, column + 1)
    return StateSpace(system.A, system.B[:, columns], system.C[rows], system.D[rows, columns], system.dt)


def simulate(truth, controller, seconds=8.0, substeps=4, count=2 * np.pi / 4096):
    """Step responses of all nonlinear pendulums at once: times, positions (sample, unit) and torques."""
    n, units = round(seconds / DT), len(truth.unit_ids)
    reference = np.where(np.arange(n) * DT < 4.0, REFERENCE_RAD, -REFERENCE_RAD)
    K, x, k = controller, np.zeros((2, units)), np.zeros((controller.n_states, units))
    positions, torques = np.empty((n, units)), np.empty((n, units))
    for i in range(n):
        error = np.rint(x[:1] / count) * count - reference[i]
        torque = np.clip(K.C @ k + K.D @ error, -20, 20)
        k = K.A @ k + K.B @ error
        positions[i], torques[i] = x[0], torque[0]
        for _ in range(substeps):
            x = runge_kutta(truth, x, torque[0], DT / substeps)
    return np.arange(n) * DT, reference, positions, torques


def runge_kutta(truth, x, torque, h):
    """One step of order four."""

    def slope(x):
        return np.stack([x[1], truth.acceleration(x[0], x[1], torque)])

    a = slope(x)
    b = slope(x + h / 2 * a)
    c = slope(x + h / 2 * b)
    d = slope(x + h * c)
    return x + h / 6 * (a + 2 * b + 2 * c + d)


def judged(response):
    """Overshoot, error one second after the steps, and torque: the worst unit counts."""
    times, reference, positions, torques = response
    settled = (times % 4.0) >= 1.5
    error = np.sqrt(np.mean((positions[settled] - reference[settled, None]) ** 2, axis=0)) / REFERENCE_RAD
    overshoot = (np.max(positions[times < 4.0], axis=0) - REFERENCE_RAD) / REFERENCE_RAD
    return {
        "settled_error_percent": {"mean": round(100 * float(error.mean()), 2), "worst": round(100 * float(error.max()), 2)},
        "overshoot_percent": {"mean": round(100 * float(overshoot.mean()), 1), "worst": round(100 * float(overshoot.max()), 1)},
        "largest_torque": round(float(np.abs(torques).max()), 2),
    }


def draw(responses, path):
    """Draw the step responses of every unit under every controller."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "kros"
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(responses), figsize=(4 * len(responses), 3), sharey=True, layout="constrained")
    for axis, (name, (times, reference, positions, _)) in zip(axes, responses.items(), strict=True):
        axis.plot(times, positions, lw=0.8, color="tab:blue", alpha=0.7)
        axis.plot(times, reference, "k--", lw=1)
        axis.set(title=name, xlabel="time, s", ylim=(-0.6, 0.6))
    axes[0].set_ylabel("position, rad")
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
