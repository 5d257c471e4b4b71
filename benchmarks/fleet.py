"""Many units through read, calibrate, identify, outliers, nominal and weights: processor time and memory a stage, and how they grow.

    python benchmarks/fleet.py --units 100 1000 --seconds 5

Each size is run in a process of its own on recordings that are simulated once (`--folder`): harmonic drives, 2 conditions x 4 episodes, Parquet,
read in place. Prints a table of processor time a unit in milliseconds with the fitted exponent of the time over the number of units
(1 is linear), and the largest memory after each stage. The search for the nominal and the weights are also counted by themselves.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

EPISODES = 4
POINTS, ORDER = 200, 2  # of the weights: frequencies and order
BLOCK = 50  # units simulated at once
Times = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--seconds", type=float, default=5.0, help="length of an episode")
    parser.add_argument("--folder", type=Path, help="where recordings are kept; default a temporary one")
    parser.add_argument("--refine", action="store_true", help="refine the models too")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        print(json.dumps(measured(options.folder / "recordings", options.one, options.refine)))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        found = {}
        for units in options.units:
            place = folder / f"{units}x{options.seconds:g}"
            simulate(place / "recordings", units, options.seconds)
            command = [
                sys.executable,
                __file__,
                "--one",
                str(units),
                "--folder",
                str(place),
                *(["--refine"] if options.refine else []),
            ]
            found[units] = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
            print(json.dumps({"units": units, **found[units]}), flush=True)
    print(table(found))


def simulate(folder: Path, units: int, seconds: float) -> None:
    """Write recordings of drives; every block of them is drawn from a seed of its own."""
    from kros.core.artifacts import read_json
    from kros.data import EpisodeKey, Unit, from_arrays
    from kros.data.readers.parquet import write_group, write_index
    from kros.data.recording import usable_episodes
    from kros.plants import HarmonicDrivePopulation

    if (folder / "population.json").exists() and len(read_json(folder / "population.json")["units"]) == units:
        return
    folder.mkdir(parents=True, exist_ok=True)
    records: list[Any] = []
    names: tuple[Unit, ...] = ()
    for block in range(0, units, BLOCK):
        count = min(BLOCK, units - block)
        made = (
            HarmonicDrivePopulation(n_units=count, n_episodes=EPISODES, seconds=seconds, seed=1000 + block)
            .simulate()
            .population
        )
        own = tuple(Unit(f"{block + k + 1:06d}", "population") for k in range(count))
        renamed = dict(zip(made.unit_ids, own, strict=True))
        data = {EpisodeKey(renamed[k.unit].id, k.condition, k.episode): made.read(k) for k in made.episodes}
        whole = from_arrays(data, made.channels, made.sample_period_s, units=own, metadata=made.metadata)
        for unit, condition, _ in whole.groups():
            group = whole.select([unit], [condition])
            records.append(write_group(group, folder, usable_episodes(group)))
        names += own
    write_index(replace(whole, units=names), records, folder)


def measured(recordings: Path, units: int, refine: bool) -> dict[str, Any]:
    """Run the stages and return processor time, s, and the largest memory after each, GB."""
    import kros
    from kros.core.work import Work
    from kros.identify.calibration import calibrate
    from kros.identify.identified import IdentifiedModels
    from kros.identify.identify import with_models
    from kros.identify.presets import resolve_lifting, resolve_phase
    from kros.identify.settings import CalibrationSettings, IdentifySettings, LiftingSettings
    from kros.identify.survey import survey
    from kros.uncertainty import choose_nominal
    from kros.uncertainty.outliers.population import score_population
    from kros.uncertainty.settings import QuantifySettings

    times: Times = {}
    memory: Times = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        began, wall = time.process_time(), time.perf_counter()
        yield
        times[name] = time.process_time() - began
        times[f"{name} (wall)"] = time.perf_counter() - wall
        memory[name] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(
            f"{units} units, {name}: {1000 * times[name] / units:.2f} ms each, {memory[name]:.2f} GB",
            file=sys.stderr,
            flush=True,
        )

    settings = QuantifySettings.of({"n_freqs": POINTS, "max_order": ORDER}, "fleet")
    with stage("open"):
        population = kros.read(recordings)
    lifting = resolve_lifting(LiftingSettings(), CalibrationSettings(), population)
    spec = resolve_phase(CalibrationSettings(), population, lifting)
    assert spec is not None
    with stage("read"):
        population, facts = survey(population)
    with stage("calibrate"):
        calibration = calibrate(population, facts, spec, Work())
    with stage("identify"):
        base = IdentifiedModels(population, facts, lifting, calibration)
        models = with_models(base, IdentifySettings(refine=refine), Work())
    with stage("outliers"):
        _, scores = score_population(models, settings, Work())
    with stage("nominal"):
        first = models.models()
        responses = first.scaled_responses(first.frequencies(POINTS), list(first.unit_ids))
        nominal = first.unit_ids[choose_nominal(responses, settings.form).index]
    with stage("weights"):
        units_of = {"unit_ids": list(first.unit_ids), "nominal": nominal, "max_order": ORDER}
        found = kros.quantify(first, settings.form, first.frequencies(POINTS), **units_of)
    return {
        "times": times,
        "memory": memory,
        "nominal": nominal,
        "outliers": sum(bool(row["outlier"]) for row in scores),
        "cover_max": found.weight.cover_max,
    }


def table(found: dict[int, dict[str, Any]]) -> str:
    """Return milliseconds a unit for every stage and size, and the exponent between the smallest and the largest size."""
    import numpy as np

    sizes = sorted(found)
    stages = [name for name in found[sizes[0]]["times"] if not name.endswith("(wall)")]
    lines = [
        "| stage | " + " | ".join(f"{n} units, ms each" for n in sizes) + " | exponent | GB |",
        "|---" * (len(sizes) + 3) + "|",
    ]
    for name in stages:
        own = [found[n]["times"][name] for n in sizes]
        slope = np.log(own[-1] / own[0]) / np.log(sizes[-1] / sizes[0]) if len(sizes) > 1 else float("nan")
        cells = " | ".join(f"{1000 * t / n:.2f}" for t, n in zip(own, sizes, strict=True))
        lines.append(f"| {name} | {cells} | {slope:.2f} | {found[sizes[-1]]['memory'][name]:.2f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    main()
