"""The six forms and the two sets of left coprime factors, by what worst-case H2 synthesis certifies and does: one population, one recorded input spectrum.

    python benchmarks/forms.py --loop stiff --units 12 --left-out 4

For every set: the certified worst-case error of all states, and of hidden ones where the set bounds them one by one, and the observer's error on test
episodes of units that took no part, over that of the open loop of the same model.
"""

import argparse
import logging
import sys
from dataclasses import replace

import numpy as np

import kros
from kros.data import EpisodeBatch, split_episodes
from kros.design.settings import ObserverSettings, PredictorSettings, SynthesisSettings
from kros.design.synthesize import synthesize_all
from kros.identify.calibrate import segments_of
from kros.observer import run_observer
from kros.plants import PLANTS
from kros.uncertainty.settings import UncertaintySettings

FORMS = UncertaintySettings.model_fields["form"].annotation.__args__
say = sys.stdout.write


def left_out(models, population, units):
    """Read the test episodes of units that took no part, calibrated from their training episodes."""
    spec, known, splits = models.calibration.spec, {}, split_episodes(population, None)
    for unit in units:
        known[unit] = {
            spec.parameter: models.calibration.calibrate(
                segments_of((population, splits[unit, models.facts.identify_on].train, spec)), unit
            ).phase_rad
        }
    keys = [k for (_, condition), s in splits.items() if condition == models.facts.identify_on for k in s.test]
    return EpisodeBatch.read(population, keys, parameters=known)


def percents(observer, batch):
    """Mean error of hidden states, percent of the largest value."""
    values = batch.parameters if observer.lifting.parameters else None
    error = (
        run_observer(observer, batch.measurements(observer.measured), batch.inputs, values)[..., : batch.states.shape[-1]] - batch.states
    )
    with np.errstate(over="ignore", invalid="ignore"):
        return (100 * np.sqrt(np.mean(error**2, axis=0)) / np.abs(batch.states).max(axis=0)).mean(axis=0)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("loop", "stiff"), ("units", 12), ("left-out", 4), ("seed", 301), ("spread", 3.0), ("seconds", 10.0)):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    asked = parser.parse_args()
    logging.disable(logging.WARNING)
    settings = {"n_units": asked.units, "n_episodes": 4, "seconds": asked.seconds, "seed": asked.seed, "spread": asked.spread}
    population = PLANTS["harmonic-drive"](**settings, loop=asked.loop).simulate().population
    held = population.unit_ids[: asked.left_out]
    models = kros.identify(population.select(population.unit_ids[asked.left_out :]), ["sin(100*position + phase)"])
    models = replace(models, kinds=tuple(kind for kind in models.kinds if not kind.endswith("edmd")))
    batch = left_out(models, population.select(held), held)
    say(
        f"{'set':32s} {'model':10s} {'bound':>9s} {'open loop':>9s} {'hidden states certified, %':>28s}   velocity, current over open loop\n"
    )
    for name in (*FORMS, "signals", "models"):
        form = name if name in FORMS else "additive"
        uncertain = kros.quantify(models, form=form)
        uncertain = replace(uncertain, models=models)
        chosen = SynthesisSettings(methods=("worst_case_h2",), set="form" if name in FORMS else name)
        found = synthesize_all(uncertain, chosen, ObserverSettings(baselines=("open_loop",)), PredictorSettings())
        for kind in models.kinds:
            own, loop = (found.designs.get(f"{kind}/{what}") for what in ("worst_case_h2", "open_loop"))
            if own is None or loop is None:
                say(f"{name:32s} {kind:10s} not made\n")
                continue
            facts, ratio = own.facts, percents(own.observer, batch) / percents(loop.observer, batch)
            bound = [f.get("worst_case_h2") or float("nan") for f in (facts, loop.facts)]
            each = facts.get("set_bound_percent") or {}
            shown = ", ".join(f"{k} {v:.3g}" for k, v in each.items() if k != "position" and v is not None)
            say(f"{name:32s} {kind:10s} {bound[0]:9.4g} {bound[1]:9.4g} {shown:>28s}   {ratio[1]:.3f}, {ratio[2]:.3f}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
