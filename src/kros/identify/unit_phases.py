"""Phases of units that took no part in a calibration, or of which there are other recordings."""

from __future__ import annotations

import logging
from dataclasses import replace

from ..core.errors import IdentificationError
from ..data.population import EpisodeKey, Population, split_episodes
from .calibration import PhaseCalibration, calibration_keys, segments_of
from .survey import RecordingFacts

log = logging.getLogger(__name__)
Values = dict[str, dict[str, float]]  # lifting parameters by unit
Texts = dict[str, str]  # by unit


def training_keys(population: Population) -> dict[tuple[str, str], tuple[EpisodeKey, ...]]:
    """Return the episodes that a unit is identified on: its training part, or its only episode."""
    groups = {(u, c): keys for u, c, keys in population.groups()}
    several = tuple(k for keys in groups.values() if len(keys) > 1 for k in keys)
    splits = split_episodes(replace(population, episodes=several))
    return groups | {group: split.train for group, split in splits.items()}


def unit_values(
    population: Population,
    calibration: PhaseCalibration | None,
    prefer: str,
    given: Values | None = None,
    facts: RecordingFacts | None = None,
) -> tuple[Values, Texts, Texts]:
    """Return the lifting parameters of units, where each came from, and why one is unknown.

    They are given, calibrated in a condition, on the episodes that facts of these recordings name, or those of the run.
    """
    known, sources, reasons = {u: dict((given or {}).get(u, {})) for u in population.unit_ids}, Texts(), Texts()
    if calibration is None:
        return known, sources, reasons
    training, spec = training_keys(population), calibration.spec
    derived = "" if spec.measured in population.states else f" on the derivative of {spec.angle}"
    for unit, values in known.items():
        if spec.parameter in values:
            sources[unit] = "given"
            continue
        by_condition = {condition: keys for (u, condition), keys in training.items() if u == unit}
        keys = by_condition.get(prefer) or next(iter(by_condition.values()))
        keys = keys if facts is None else calibration_keys(facts, unit)
        try:
            phase = calibration.calibrate(segments_of((population, keys, spec)), unit)
            sources[unit] = f"calibrated{derived}"
        except IdentificationError as error:
            if unit not in calibration.units:
                sources[unit], reasons[unit] = "unknown", str(error)
                continue
            phase, sources[unit] = calibration.units[unit], "of the run"
            log.info("unit %s: its recordings do not determine the phase; the value of the run is used", unit)
        values[spec.parameter] = phase.phase_rad
    return known, sources, reasons


def unit_parameters(
    population: Population, calibration: PhaseCalibration | None, prefer: str, facts: RecordingFacts | None = None
) -> Values:
    """Return every unit's lifting parameters, as `unit_values` finds them; refuse one that is unknown."""
    values, _, reasons = unit_values(population, calibration, prefer, facts=facts)
    for reason in reasons.values():
        raise IdentificationError(reason)
    return values
