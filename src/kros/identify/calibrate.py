"""Calibration of a population: the phase of every unit, on one branch."""

from __future__ import annotations

import logging

import numpy as np

from ..core.errors import IdentificationError
from ..core.store import digest_of
from ..core.work import Work
from ..data.population import EpisodeKey, Population
from ..data.survey import RecordingFacts
from .calibration import PhaseCalibration, PhaseSpec, Segment, UnitPhase, find_segments, resolve_branches, unit_phase

log = logging.getLogger(__name__)
Task = tuple[Population, tuple[EpisodeKey, ...], PhaseSpec]
_BLOCK = 100_000  # samples of one recording in memory


def calibrate(
    population: Population, facts: RecordingFacts, spec: PhaseSpec, work: Work | None = None
) -> PhaseCalibration:
    """Calibrate all units on training episodes; one that cannot be calibrated is left out, its reason in the log."""
    tasks = [(population.select([u]), calibration_keys(facts, u), spec) for u in facts.groups]
    recalled = (work or Work()).recall("calibrate", segments_of, tasks, [_mark(facts, t) for t in tasks], (Segment,))
    units: dict[str, UnitPhase] = {}
    for unit, segments in zip(facts.groups, recalled, strict=True):
        try:
            units[unit] = unit_phase(segments, unit, spec)
        except IdentificationError as error:
            log.warning("%s", error)
    pooled = [u for u in facts.pooled if u in units]
    if len(pooled) < (2 if len(facts.pooled) > 1 else 1):
        raise IdentificationError(
            f"Calibration: {len(pooled)} of {len(facts.pooled)} units could be calibrated, too few for a population; "
            f"check [calibrate] against the recordings (angle {spec.angle!r}, ratio {spec.ratio:g}, error "
            f"{spec.reference!r} - {spec.measured!r})."
        )
    return resolve_branches(units, pooled, spec)


def _mark(facts: RecordingFacts, task: Task) -> str | None:
    """Return what the segments of a task follow from."""
    population, keys, spec = task
    samples = facts.marks(keys)
    return None if samples is None else digest_of(population.columns, population.sample_period_s, spec, keys, samples)


def segments_of(task: Task) -> list[Segment]:
    """Find the constant-velocity segments of some episodes, each read in blocks where it is very long."""
    population, keys, spec = task
    names = population.states + population.inputs
    angle, reference = (names.index(n) for n in (spec.angle, spec.reference))
    segments, dt = [], population.sample_period_s
    for values in (block for key in keys for block in population.blocks(key, _BLOCK) if len(block) > 1):
        rate = values[:, names.index(spec.measured)] if spec.measured in names else np.gradient(values[:, angle], dt)
        segments += find_segments(values[:, angle], values[:, reference], rate, dt, spec)
    return segments


def calibration_keys(facts: RecordingFacts, unit: str) -> tuple[EpisodeKey, ...]:
    """Return the episodes that a unit is calibrated on: those of `identify_on`, or of the first condition it has."""
    every = facts.keys("train", unit)
    return facts.keys("train", unit, facts.identify_on) or tuple(k for k in every if k.condition == every[0].condition)
