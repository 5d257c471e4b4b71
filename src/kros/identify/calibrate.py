"""Calibration of a population: the phase of every unit, on one branch."""

from __future__ import annotations

import logging

import numpy as np

from ..core.errors import IdentificationError
from ..core.work import Work
from ..data.population import EpisodeKey, Population
from ..data.prepare import mark_of
from ..data.survey import RecordingFacts
from .calibration import PhaseCalibration, PhaseSpec, Segment, UnitPhase, find_segments, resolve_branches, unit_phase

log = logging.getLogger(__name__)
Task = tuple[Population, tuple[EpisodeKey, ...], PhaseSpec]


def calibrate(
    population: Population, facts: RecordingFacts, spec: PhaseSpec, work: Work | None = None
) -> PhaseCalibration:
    """Calibrate all units on training episodes; a unit that cannot be calibrated is left out, with its reason in the log."""
    tasks = [(population.select([u]), calibration_keys(facts, u), spec) for u in facts.groups]
    units: dict[str, UnitPhase] = {}
    marks = [
        None if (known := facts.marks(keys)) is None else mark_of(own.columns, own.sample_period_s, spec, keys, known)
        for own, keys, _ in tasks
    ]
    found = (work or Work()).recall("calibrate", segments_of, tasks, marks, (Segment,))
    for unit, segments in zip(facts.groups, found, strict=True):
        try:
            units[unit] = unit_phase(segments, unit)
        except IdentificationError as error:
            log.warning("%s", error)
    pooled = [u for u in facts.pooled if u in units]
    if len(pooled) < (2 if len(facts.pooled) > 1 else 1):
        raise IdentificationError(
            f"Calibration: {len(pooled)} of {len(facts.pooled)} units could be calibrated, too few for a population; check [calibrate] against the recordings "
            f"(angle {spec.angle!r}, ratio {spec.ratio:g}, error {spec.reference!r} - {spec.measured!r})."
        )
    return resolve_branches(units, pooled, spec)


def segments_of(task: Task) -> list[Segment]:
    """Find the constant-velocity segments of some episodes."""
    population, keys, spec = task
    names = population.states + population.inputs
    angle, reference = (names.index(n) for n in (spec.angle, spec.reference))
    segments, dt = [], population.sample_period_s
    for key in keys:
        values = population.read(key)
        rate = values[:, names.index(spec.measured)] if spec.measured in names else np.gradient(values[:, angle], dt)
        segments += find_segments(values[:, angle], values[:, reference], rate, dt, spec)
    return segments


def calibration_keys(facts: RecordingFacts, unit: str) -> tuple[EpisodeKey, ...]:
    """Return the training episodes that a unit is calibrated on: those of `identify_on`, or of the first condition it has."""
    own = facts.keys("train", unit)
    return facts.keys("train", unit, facts.identify_on) or tuple(k for k in own if k.condition == own[0].condition)
