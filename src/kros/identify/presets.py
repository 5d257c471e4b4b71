"""What follows from a plant and from formulas where nothing is declared."""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np

from ..core import Array, ConfigError, Names, Record, did_you_mean
from ..data import Population, split_episodes
from ..lifting import Lifting
from ..lifting.families import family
from ..lifting.formula import Formula
from .calibration import PhaseSpec
from .settings import CalibrationSettings, LiftingSettings

HARMONIC_DRIVE = "harmonic-drive"
PHASE = "phase"
_BAND = 0.1  # half the width of the band around the gearbox frequency, share of it
_EPISODES, _SAMPLES = 40, 5000  # of the training recordings that centres of families are found among, at most


def resolve_lifting(
    declared: LiftingSettings,
    calibration: CalibrationSettings,
    population: Population,
    test: Iterable[str] | None = None,
) -> Lifting:
    """Return the lifting that is declared, or the plant's (35); families see no episodes of `test`."""
    inputs, functions = declared.input_functions, declared.functions or ()
    if declared.functions is None and not declared.families and population.metadata.get("plant") == HARMONIC_DRIVE:
        functions = (f"sin({_ratio(calibration.ratio, population):g}*position + {PHASE})",)
    functions = sum((family(table, partial(_sample, population, test)) for table in declared.families), functions)
    parameters = (PHASE,) if any(re.search(rf"\b{PHASE}\b", f) for f in functions + inputs) else ()
    lifting = Lifting(population.states, functions, parameters, population.inputs, inputs)
    _ = lifting.separation, lifting.input_separation  # refused before anything is written
    return lifting if lifting.history or inputs else Lifting(population.states, functions, parameters)


def lifting_settings(lifting: LiftingSettings | Mapping[str, object] | Sequence[str] | None) -> LiftingSettings:
    """Return the settings that formulas, a table as in a study, or nothing stand for."""
    if isinstance(lifting, LiftingSettings):
        return lifting
    if isinstance(lifting, str):
        raise ConfigError(f"Lifting {lifting!r}: is one text; give a list of formulas, ['{lifting}'].")
    raw = dict(lifting) if isinstance(lifting, Mapping) else {"functions": None if lifting is None else tuple(lifting)}
    return LiftingSettings.of(raw, "Lifting")


def _sample(population: Population, test: Iterable[str] | None, names: Names) -> Array:
    """Return values of formulas on training episodes, one of every unit and condition, thinned."""
    keys = [split.train[0] for split in split_episodes(population, test).values()]
    keys = keys[:: max(1, -(-len(keys) // _EPISODES))]
    known = population.states + population.inputs
    rows = []
    for key in keys:
        values = population.read(key)
        values = values[:: max(1, len(values) * len(keys) // _SAMPLES)]
        columns = dict(zip(known, values.T, strict=False))
        evaluated = [np.broadcast_to(Formula(name, known).evaluate(columns), len(values)) for name in names]
        rows.append(np.stack(evaluated, axis=-1))
    return np.concatenate(rows)


def resolve_phase(declared: CalibrationSettings, population: Population, lifting: Lifting) -> PhaseSpec | None:
    """Return what has to be calibrated: nothing, or the phase of a disturbance that is fixed to an angle."""
    if not lifting.parameters:
        return None
    known: Record = declared.model_dump(exclude_none=True)
    if "ratio" not in known and "gear_ratio" not in population.metadata:
        known = _written_ratio(lifting, population.states, declared.angle) | known
    known["ratio"] = _ratio(known.get("ratio"), population)
    spec, channels = PhaseSpec(**known), population.states + population.inputs
    for name in (spec.angle, spec.reference, spec.measured):
        if name not in channels:
            problem = f"there is no channel {name!r} in {', '.join(channels)}{did_you_mean(name, channels) or ';'}"
            raise ConfigError(f"Calibration: {problem} set calibrate.angle, .reference and .measured.")
    return spec


def _written_ratio(lifting: Lifting, angles: Sequence[str], angle: str | None) -> Record:
    """Return angle and ratio where every function of the phase reads ``ratio*angle + phase``."""
    import sympy as sp

    phase, pairs = sp.Symbol(PHASE, real=True), set()
    nodes = (node for formula in lifting.formulas for node in formula.written.atoms(sp.Function))
    for argument in {a for node in nodes for a in node.args if phase in a.free_symbols}:
        rest = sp.expand(argument / argument.coeff(phase)) - phase if argument.coeff(phase) != 0 else phase
        names = [symbol.name for symbol in rest.free_symbols]
        ratio = sp.diff(rest, sp.Symbol(names[0], real=True)) if len(names) == 1 else phase
        if ratio.is_number and names[0] in angles and angle in (None, names[0]):
            pairs.add((names[0], float(ratio)))
    return dict(zip(("angle", "ratio"), pairs.pop(), strict=True)) if len(pairs) == 1 else {}


def gearbox_band_hz(
    declared: CalibrationSettings, population: Population, top_speed: float
) -> tuple[float, float] | None:
    """Return the band around the gearbox frequency at top speed, within 10 %; None for other plants."""
    if population.metadata.get("plant") != HARMONIC_DRIVE or not top_speed:
        return None
    centre = _ratio(declared.ratio, population) * top_speed / (2 * np.pi)
    return (1 - _BAND) * centre, (1 + _BAND) * centre


def _ratio(declared: float | None, population: Population) -> float:
    """Return the ratio that is declared, or that of the plant's gear."""
    ratio = declared if declared is not None else population.metadata.get("gear_ratio")
    if ratio is None:
        raise ConfigError("Calibration: the ratio of the disturbance to the angle is unknown; set calibrate.ratio.")
    return float(ratio)
