"""`kros loop` on random controllers: none is called safe that diverges, and few are undecided.

python benchmarks/closed_loop.py RUN [--controllers 200]: draws controllers over the observers of a run, and simulates what is
called safe: every unit's nonlinear model with the observer as it is deployed on other episodes than those of the verdict,
and random members of the uncertain set, by the poles of their loops.
"""

from __future__ import annotations

import argparse
import collections
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from kros.core import StateSpace, block_diagonal, hinf_norm
from kros.data import EpisodeBatch
from kros.evaluate.closed_loop import Controller, close_loop
from kros.evaluate.closed_loop.linear_loop import LinearLoop
from kros.evaluate.closed_loop.simulated_loop import diverging
from kros.identify import ModelSet
from kros.observer import Observer
from kros.synthesis.generalized_plant import interconnect
from kros.uncertainty.quantify import UncertainModels

VERDICT, SAMPLES, MEMBERS, LARGEST = 1000, 5000, 20, 100.0


def drawn(rng: np.random.Generator, models: ModelSet) -> Controller:
    """Return a random controller of order 0 to 2 on some estimates and inputs, its gain over six decades."""
    states, inputs, order = models.lifting.states, models.recorded_inputs, int(rng.integers(3))
    read = sorted(rng.choice(states, int(rng.integers(1, len(states) + 1)), replace=False))
    write = sorted(rng.choice(inputs, int(rng.integers(1, len(inputs) + 1)), replace=False))
    x = np.array([models.output_scale[states.index(name)] for name in read])
    u = np.array([models.input_scale[inputs.index(name)] for name in write])
    size = 10 ** rng.uniform(-5, 1)
    A = np.diag(rng.uniform(0.0, 0.99, order))
    B, C = rng.normal(size=(order, len(read))), rng.normal(size=(len(write), order)) * (1 - np.diag(A))
    D = rng.normal(size=(len(write), len(read)))
    matrices = {"A": A, "B": B / x, "C": size * C * u[:, None], "D": size * D * u[:, None] / x}
    names = {"inputs": read, "outputs": write, "sample_period_s": models.sample_period_s}
    return Controller(**{name: matrix.tolist() for name, matrix in matrices.items()}, **names)


def unstable_members(rng: np.random.Generator, loop: LinearLoop) -> int:
    """Return how many random members of the set, filters of gain one around the loop, are not stable."""
    blocks, count = loop.perturbed(), 0
    (w, z), (r, e), dt = np.sum(blocks.sizes[:-1], axis=0), blocks.sizes[-1], blocks.system.dt
    wires = {"Delta": {"M": np.eye(z, z + e)}, "M": {"Delta": np.eye(w + r, w), "r": np.eye(w + r, r, -w)}}
    for _ in range(MEMBERS):
        deltas = []
        for rows, columns in blocks.sizes[:-1]:
            pole, parts = rng.uniform(-0.9, 0.999), [(1, columns), (rows, 1), (rows, columns)]
            one = StateSpace([[pole]], *(rng.normal(size=shape) for shape in parts), dt)  # type: ignore[call-arg]
            size = hinf_norm(one) * (1 + 1e-6)
            deltas.append(replace(one, C=one.C / size, D=one.D / size))
        systems = {"M": blocks.system, "Delta": block_diagonal(deltas)}
        count += not interconnect(systems, wires, {"r": r}, {"e": {"M": np.eye(e, z + e, z)}}).is_stable()
    return count


def campaign(run: Path, controllers: int, seed: int = 0) -> dict:
    """Judge random controllers, and look for what diverges among those that are called safe."""
    found, rng, began = UncertainModels.load(run), np.random.default_rng(seed), time.monotonic()
    names = [
        path.relative_to(run / "observers").with_suffix("").as_posix() for path in (run / "observers").glob("*/*.json")
    ]
    counts, wrong = collections.defaultdict(collections.Counter), []
    observers = {
        name: Observer.load(run / "observers" / f"{name}.json") for name in sorted(names) if "relift" not in name
    }
    for k in range(controllers):
        name = list(observers)[k % len(observers)]
        observer, kind = observers[name], name.partition("/")[0]
        models, uncertain = found.models.models(kind), found.sets[kind]
        controller = drawn(rng, models)
        result = close_loop(observer, found, controller, VERDICT)
        counts[name][result.status] += 1
        if result.status == "SAFE":
            K = controller.between(observer, models)
            last = [found.models.facts.keys("train", unit, models.condition)[-1] for unit in uncertain.unit_ids]
            batch = EpisodeBatch.read(found.models.population, last, SAMPLES)
            units = diverging(observer, models, batch, controller, LARGEST)
            members = unstable_members(rng, LinearLoop.of(observer, models, uncertain, K)[0])
            if units or members:
                wrong.append([name, controller.model_dump(), units, members])
        print(k, name, result.lines()[0][:150], f"({len(wrong)} wrong)", flush=True)
    total = sum(counts.values(), collections.Counter())
    return {"controllers": controllers, **total, "wrong": wrong, "seconds": round(time.monotonic() - began)} | {
        "by observer": {name: dict(of) for name, of in counts.items()}
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--controllers", type=int, default=200)
    given = parser.parse_args()
    print(json.dumps(campaign(given.run, given.controllers), indent=1))
