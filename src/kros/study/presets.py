"""Defaults that follow from the plant a reader names, so that the smallest study needs two lines."""

from __future__ import annotations

import re
from functools import partial

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from ..data.population import Population, split_episodes
from ..identify import PhaseSpec
from ..lifting import Formula, Lifting, concatenate, family
from .config import StudyConfig

Array = npt.NDArray[np.float64]
HARMONIC_DRIVE = "harmonic-drive"
PHASE = "phase"
_SAMPLED_EPISODES = 40
_SAMPLES = 5000


def resolve_lifting(config: StudyConfig, population: Population) -> Lifting:
    """Return the lifting that the study declares, or the plant's own (35)."""
    declared = config.lifting
    inputs = declared.input_functions
    if declared.functions is None and not declared.families:
        if population.metadata.get("plant") == HARMONIC_DRIVE:
            functions: tuple[str, ...] = (f"sin({_ratio(config, population):g}*position + {PHASE})",)
        else:
            functions = ()
    else:
        sample = partial(_sample, config, population)
        functions = concatenate(declared.functions or (), *(family(table, sample) for table in declared.families))
    parameters = declared.parameters
    if parameters is None:
        parameters = (PHASE,) if any(re.search(rf"\b{PHASE}\b", f) for f in functions + inputs) else ()
    lifting = Lifting(population.states, functions, parameters, population.inputs, inputs)
    _ = lifting.separation, lifting.input_separation  # refused before anything is written
    return lifting if lifting.history or inputs else Lifting(population.states, functions, parameters)


def _sample(config: StudyConfig, population: Population, names: tuple[str, ...]) -> Array:
    """Values of formulas on training episodes, one of every unit and condition, thinned to some thousand samples."""
    keys = [split.train[0] for split in split_episodes(population, config.split.test).values()]
    keys = keys[:: max(1, -(-len(keys) // _SAMPLED_EPISODES))]
    known = population.states + population.inputs
    rows = []
    for key in keys:
        values = population.read(key)
        values = values[:: max(1, len(values) * len(keys) // _SAMPLES)]
        columns = {name: values[:, i] for i, name in enumerate(known)}
        evaluated = [np.broadcast_to(Formula(name, known).evaluator(columns), len(values)) for name in names]
        rows.append(np.stack(evaluated, axis=-1))
    return np.concatenate(rows)


def resolve_phase(config: StudyConfig, population: Population, lifting: Lifting) -> PhaseSpec | None:
    """Return what has to be calibrated for the lifting's parameters."""
    if not lifting.parameters:
        return None
    if lifting.parameters != (PHASE,):
        raise ConfigError(
            f"Lifting parameters {lifting.parameters}: only {PHASE!r} can be calibrated; write other constants into the formulas."
        )
    declared = {k: v for k, v in config.calibrate.model_dump().items() if v is not None}
    if "ratio" not in declared:
        declared["ratio"] = _ratio(config, population)
    spec = PhaseSpec(**declared)
    known = population.states + population.inputs
    for name in (spec.angle, spec.reference, spec.measured):
        if name not in known:
            raise ConfigError(
                f"Calibration: there is no channel {name!r} in {', '.join(known)}; set calibrate.angle, .reference and .measured."
            )
    return spec


def gearbox_band_hz(config: StudyConfig, population: Population, top_speed: float) -> tuple[float, float] | None:
    """Return the band around the gearbox frequency at top speed, within 10 %; None for other plants."""
    if population.metadata.get("plant") != HARMONIC_DRIVE or not top_speed:
        return None
    centre = _ratio(config, population) * top_speed / 6.283185307179586
    return 0.9 * centre, 1.1 * centre


def _ratio(config: StudyConfig, population: Population) -> float:
    ratio = config.calibrate.ratio if config.calibrate.ratio is not None else population.metadata.get("gear_ratio")
    if ratio is None:
        raise ConfigError("Calibration: the ratio of the disturbance to the angle is unknown; set calibrate.ratio.")
    return float(ratio)
