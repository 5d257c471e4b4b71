"""What follows from a plant and from formulas where nothing is declared, so that the shortest call and the smallest study work."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from ..core.files import did_you_mean
from ..data.population import Population, split_episodes
from ..lifting import Lifting
from ..lifting.families import family
from ..lifting.formula import Formula
from .calibration import PhaseSpec
from .settings import CalibrationSettings, LiftingSettings

Array = npt.NDArray[np.float64]
HARMONIC_DRIVE = "harmonic-drive"
PHASE = "phase"
_SAMPLED_EPISODES = 40
_SAMPLES = 5000


def resolve_lifting(
    declared: LiftingSettings,
    calibration: CalibrationSettings,
    population: Population,
    test: Iterable[str] | None = None,
) -> Lifting:
    """Return the lifting that is declared, or the plant's own (35); `test` names held-out episodes, of which families see nothing."""
    inputs = declared.input_functions
    if declared.functions is None and not declared.families:
        if population.metadata.get("plant") == HARMONIC_DRIVE:
            functions: tuple[str, ...] = (f"sin({_declared_ratio(calibration, population):g}*position + {PHASE})",)
        else:
            functions = ()
    else:
        sample = partial(_sample, population, test)
        functions = sum((family(table, sample) for table in declared.families), declared.functions or ())
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


def _sample(population: Population, test: Iterable[str] | None, names: tuple[str, ...]) -> Array:
    """Values of formulas on training episodes, one of every unit and condition, thinned to some thousand samples."""
    keys = [split.train[0] for split in split_episodes(population, test).values()]
    keys = keys[:: max(1, -(-len(keys) // _SAMPLED_EPISODES))]
    known = population.states + population.inputs
    rows = []
    for key in keys:
        values = population.read(key)
        values = values[:: max(1, len(values) * len(keys) // _SAMPLES)]
        columns = {name: values[:, i] for i, name in enumerate(known)}
        evaluated = [np.broadcast_to(Formula(name, known).evaluate(columns), len(values)) for name in names]
        rows.append(np.stack(evaluated, axis=-1))
    return np.concatenate(rows)


def resolve_phase(declared: CalibrationSettings, population: Population, lifting: Lifting) -> PhaseSpec | None:
    """Return what has to be calibrated for the lifting's parameters: nothing, or the phase of a disturbance that is fixed to an angle."""
    if not lifting.parameters:
        return None
    if lifting.parameters != (PHASE,):
        raise ConfigError(
            f"Lifting parameters {lifting.parameters}: only {PHASE!r} can be calibrated; write other constants into the formulas."
        )
    known = {k: v for k, v in declared.model_dump().items() if v is not None}
    if "ratio" not in known and "gear_ratio" in population.metadata:
        known["ratio"] = float(population.metadata["gear_ratio"])
    if "ratio" not in known:
        known = _written_ratio(lifting, population.states, known.get("angle")) | known
    if "ratio" not in known:
        raise ConfigError("Calibration: the ratio of the disturbance to the angle is unknown; set calibrate.ratio.")
    spec = PhaseSpec(**known)
    channels = population.states + population.inputs
    for name in (spec.angle, spec.reference, spec.measured):
        if name not in channels:
            raise ConfigError(
                f"Calibration: there is no channel {name!r} in {', '.join(channels)}{did_you_mean(name, channels) or ';'} set "
                "calibrate.angle, .reference and .measured."
            )
    return spec


def _written_ratio(lifting: Lifting, angles: Sequence[str], wanted: str | None) -> dict[str, str | float]:
    """Return angle and ratio where all functions of the phase have it beside one angle times one number, ``ratio*angle + phase``."""
    import sympy as sp

    phase, found = sp.Symbol(PHASE, real=True), set()
    for formula in lifting.formulas:
        for argument in {
            a for node in formula.written.atoms(sp.Function) for a in node.args if phase in a.free_symbols
        }:
            rest = sp.expand(argument / argument.coeff(phase)) - phase if argument.coeff(phase) != 0 else phase
            symbols = {s.name for s in rest.free_symbols}
            if len(symbols) == 1 and (name := symbols.pop()) in angles and wanted in (None, name):
                ratio = sp.diff(rest, sp.Symbol(name, real=True))
                if ratio.is_number:
                    found.add((name, float(ratio)))
    return dict(zip(("angle", "ratio"), found.pop(), strict=True)) if len(found) == 1 else {}


def gearbox_band_hz(
    declared: CalibrationSettings, population: Population, top_speed: float
) -> tuple[float, float] | None:
    """Return the band around the gearbox frequency at top speed, within 10 %; None for other plants."""
    if population.metadata.get("plant") != HARMONIC_DRIVE or not top_speed:
        return None
    centre = _declared_ratio(declared, population) * top_speed / (2 * np.pi)
    return 0.9 * centre, 1.1 * centre


def _declared_ratio(declared: CalibrationSettings, population: Population) -> float:
    ratio = declared.ratio if declared.ratio is not None else population.metadata.get("gear_ratio")
    if ratio is None:
        raise ConfigError("Calibration: the ratio of the disturbance to the angle is unknown; set calibrate.ratio.")
    return float(ratio)
