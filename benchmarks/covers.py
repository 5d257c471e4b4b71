"""Weights of simulated populations, verified by other means than those that made them.

    python benchmarks/covers.py --populations stiff:0:1 stiff:1:3 soft:2:1

For every form and kind of model: orders, overbound, time of the fit, and the largest ratio between residuals and weights on a grid
20 times denser than the fit's, at every pole and zero of the units' models and of the weights, and around the highest maxima found there.
Residuals come from solves at single frequencies and pseudo-inverses (`numpy.linalg`), not from the package. A population is drives, simulated
and identified in a folder that `--keep` retains; overbounds are costs above the optimal cover's, mean log left plus mean log right.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import kros
from kros.core import StateSpace
from kros.core.frequency import log_grid, nyquist_hz
from kros.data import write_parquet
from kros.identify import ModelSet
from kros.plants import HarmonicDrivePopulation
from kros.study import validate_config
from kros.study.config import Stage
from kros.uncertainty import Form, UncertainModel, quantify
from kros.uncertainty.weights.cover import Weight

Array = npt.NDArray[Any]
HEADER = "| form | model | population | orders | cover_max, fit | cover_max, independent | overbound, dB | seconds |"
DENSER, MAXIMA, FINER = 20, 40, 200


def main() -> None:
    """Print one row of a table for every weight."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--populations", nargs="+", default=["stiff:0:1", "stiff:1:3", "soft:2:1"], help="loop:seed:spread"
    )
    parser.add_argument("--models", nargs="+", default=["koopman", "linear", "koopman_edmd", "linear_edmd"])
    parser.add_argument("--forms", nargs="+", default=[form.value for form in Form])
    parser.add_argument("--max-order", type=int, default=4)
    parser.add_argument("--tolerance-db", type=float, default=1.0)
    parser.add_argument("--units", type=int, default=12)
    parser.add_argument("--keep", type=Path, help="folder of the identified models, used again where it has them")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = options.keep or Path(folder)
        sys.stdout.write(f"{HEADER}\n{'|---' * 8}|\n")
        for population in options.populations:
            made = models_of(place, population, options.units)
            for model in options.models:
                models = ModelSet.load(made / model)
                for form in options.forms:
                    sys.stdout.write(row(models, form, model, population, options) + "\n")
                    sys.stdout.flush()


def models_of(place: Path, population: str, units: int) -> Path:
    """Simulate and identify one population, unless it is there."""
    loop, seed, spread = population.split(":")
    folder = place / f"pop_{loop}_{seed}_{spread}"
    if not (folder / "run" / "models").exists():
        drives = HarmonicDrivePopulation(units, 10, 20.0, int(seed), spread=float(spread), outlier=False, loop=loop)
        write_parquet(drives.simulate().population, folder / "recordings")
        raw = {"data": {"source": str(folder / "recordings"), "reader": "parquet"}, "identify": {"refine": True}}
        kros.run(validate_config(raw, folder), folder / "run", until=Stage.IDENTIFY, workers=2)
    return folder / "run" / "models"


def row(models: ModelSet, form: str, name: str, population: str, options: argparse.Namespace) -> str:
    """Quantify, verify, and return a row."""
    grid, limits = (
        log_grid(models.sample_period_s),
        {"max_order": options.max_order, "tolerance_db": options.tolerance_db},
    )
    start = time.process_time()
    found = quantify(models, form, grid, **limits)
    seconds = time.process_time() - start
    ratio = independent_cover_max(found, models.systems())
    weight: Weight = found.weight
    orders = f"{' '.join(map(str, weight.left_orders))}, {' '.join(map(str, weight.right_orders))}"
    return (
        f"| {form} | {name} | {population} | {orders} | {weight.cover_max:.7f} | {ratio:.7f} "
        f"| {weight.overbound_db_max:.2f} | {seconds:.2f} |"
    )


def independent_cover_max(found: UncertainModel, units: StateSpace) -> float:
    """Return the largest `sigma_max(W_L^-1 E_k W_R^-1)` found by the slow means described above."""
    dt = found.nominal_system.dt
    inside = found.freqs_hz[found.freqs_hz > 0]
    dense = np.interp(np.arange((len(inside) - 1) * DENSER + 1) / DENSER, np.arange(len(inside)), np.log(inside))
    systems = [
        found.nominal_system,
        found.weight.left,
        found.weight.right,
        *(units[k] for k in range(units.batch_shape[0])),
    ]
    bends = np.concatenate([bends_hz(s) for s in systems])
    freqs = np.unique(
        np.concatenate([np.exp(dense).clip(max=nyquist_hz(dt)), bends, [nyquist_hz(dt) * 1e-9, nyquist_hz(dt)]])
    )
    ratio = ratios(found, units, freqs)
    worst = float(ratio.max())
    for unit in range(len(ratio)):  # local maxima of every unit, asked again
        r = np.concatenate([[-np.inf], ratio[unit], [-np.inf]])
        tops = np.flatnonzero((r[1:-1] >= r[:-2]) & (r[1:-1] >= r[2:]))
        tops = tops[np.argsort(-ratio[unit, tops])[: max(1, MAXIMA // len(ratio))]]
        for low, high in zip(freqs[np.maximum(tops - 1, 0)], freqs[np.minimum(tops + 1, len(freqs) - 1)], strict=True):
            worst = max(worst, float(ratios(found, units[[unit]], np.linspace(low, high, FINER // 4)).max()))
    return worst


def bends_hz(system: StateSpace) -> Array:
    """Frequencies of the poles and, of square systems with feedthrough, the zeros."""
    found = [np.ravel(system.poles())]
    if system.n_inputs == system.n_outputs and abs(np.linalg.det(system.D)) > 0:
        found.append(np.linalg.eigvals(system.A - system.B @ np.linalg.solve(system.D, system.C)))
    z = np.concatenate(found)
    angle = np.abs(np.angle(z[np.abs(z) > 0]))
    return angle[(angle > 0) & (angle < np.pi)] / (2 * np.pi * system.dt)


def ratios(found: UncertainModel, units: StateSpace, freqs: Array) -> Array:
    """Return the ratio for every unit and frequency, from the definition."""
    into = found.input_scale
    left, right = response(found.weight.left, freqs), response(found.weight.right, freqs)
    G = response(found.nominal_system, freqs) / found.output_scale[:, None] * into
    out = []
    for k in range(units.batch_shape[0]):
        Gp = response(units[k], freqs) / found.output_scale[:, None] * into
        E = residual(found.form, G, Gp)
        scaled = np.linalg.solve(left, E) @ np.linalg.inv(right)
        out.append(np.linalg.svd(scaled, compute_uv=False)[:, 0])
    return np.array(out)


def residual(form: Form, G: Array, Gp: Array) -> Array:
    """Residual of a form as in the documentation's table."""
    pinv, rest = np.linalg.pinv, Gp - G
    before = {"input_multiplicative": G, "inverse_additive": Gp, "inverse_input_multiplicative": Gp}.get(form.value)
    after = {"output_multiplicative": G, "inverse_additive": G, "inverse_output_multiplicative": Gp}.get(form.value)
    rest = rest if before is None else pinv(before) @ rest
    return rest if after is None else rest @ pinv(after)


def response(system: StateSpace, freqs: Array) -> Array:
    """Return the frequency response by solves, shape (frequency, p, m)."""
    z = np.exp(2j * np.pi * freqs * system.dt)[:, None, None]
    return np.asarray(
        system.C
        @ np.linalg.solve(
            z * np.eye(system.n_states) - system.A, np.broadcast_to(system.B + 0j, (len(freqs), *system.B.shape))
        )
        + system.D
    )


if __name__ == "__main__":
    main()
