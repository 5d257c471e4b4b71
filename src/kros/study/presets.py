"""Defaults that follow from the plant a reader names, so that the smallest study needs two lines."""

from __future__ import annotations

from ..core.errors import ConfigError
from ..data.population import Population
from ..identify import PhaseSpec
from ..lifting import Lifting
from .config import StudyConfig

HARMONIC_DRIVE = "harmonic-drive"
PHASE = "phase"


def resolve_lifting(config: StudyConfig, population: Population) -> Lifting:
    """Return the lifting that the study declares, or the plant's own (35)."""
    declared = config.lifting
    if declared.functions is not None:
        parameters = (
            declared.parameters if declared.parameters is not None else ((PHASE,) if any(PHASE in f for f in declared.functions) else ())
        )
        return Lifting(population.states, declared.functions, parameters)
    if population.metadata.get("plant") == HARMONIC_DRIVE:
        return Lifting(population.states, (f"sin({_ratio(config, population):g}*position + {PHASE})",), (PHASE,))
    return Lifting(population.states)


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
