"""Phase calibration of a periodic disturbance that is fixed to an angle (Appendix B, (40)-(41)).

A disturbance ``sin(r*theta + phi)`` reaches the tracking error through a loop with a lag ``eta`` that depends on speed.
In steady motion the error's phase against the angle is ``phi + eta`` forward and ``phi - eta`` in reverse, so the mean
over both directions that the paper takes cancels to noise where ``eta`` is near 90 degrees. Here each direction is
averaged by itself:

    phi = (psi_forward + psi_reverse) / 2,      eta = (psi_forward - psi_reverse) / 2      (modulo pi, one branch)

and the branch is chosen for the whole population at once, so that every unit's lag lies near the population's mean lag.

Symbols
-------
e     : tracking error, reference - measured; its periodic part at constant reference is that of -measured
theta : angle, rad;  r : ratio of the disturbance to the angle
psi_i : phase of the error in segment i, ``atan2(<e, cos r theta>, <e, sin r theta>)``, the closed form of (40)

Phases of units that took no part in a calibration, or of which there are other recordings.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..core import Array, IdentificationError, Storable, Work
from ..core.arrays import Texts as Texts
from ..core.linalg import pieces
from ..data import Population, split_episodes
from ..data.population import Keys
from .survey import RecordingFacts

log = logging.getLogger(__name__)
_BLOCK = 100_000  # samples of one recording at once


@dataclass(frozen=True)
class PhaseSpec:
    """What to calibrate: the disturbance ``sin(ratio * angle + parameter)`` seen in ``reference - measured``, and how.

    Examples
    --------
    >>> from kros.identify import PhaseSpec
    >>> PhaseSpec(angle="position", ratio=50.0).parameter
    'phase'
    """

    angle: str = "position"
    ratio: float = 100.0  # periods a radian
    reference: str = "target_velocity"  # commanded speed
    measured: str = "velocity"  # speed that follows it
    parameter: str = "phase"  # its name in formulas
    settle: float = 0.005  # share of an episode left out at the start of a segment, in which the loop settles
    steady: float = 20.0  # a constant speed takes longer than one in so many parts of the episode to its maximum
    least_speed: float = 0.1  # of the largest commanded one, below which friction hides the disturbance
    least_periods: float = 5.0  # of the disturbance in a segment
    least_samples: float = 4.0  # in a period
    speed_tolerance: float = 0.02  # share within which segments have one speed, and one lag
    least_concentration: float = 0.8  # mean resultant below which the log warns of segments or lags that disagree


@dataclass(frozen=True)
class Segment:
    """Phase of the error over one stretch of constant velocity."""

    speed: float  # negative in reverse
    phase: float


@dataclass(frozen=True)
class UnitPhase:
    """Calibration of one unit: phase and lag on the same branch, and how well the segments agree."""

    phase_rad: float
    lag_rad: float
    concentration: float
    n_segments: int

    def on_branch_of(self, lag_rad: float) -> UnitPhase:
        """Return the same calibration with the lag within 90 degrees of `lag_rad`."""
        turn = np.pi * np.round((self.lag_rad - lag_rad) / np.pi)
        return replace(self, phase_rad=wrap(self.phase_rad - turn), lag_rad=self.lag_rad - turn)


@dataclass(frozen=True)
class PhaseCalibration(Storable):
    """Phases of a population, on one branch.

    `lag_rad` is the mean lag of the population; a new unit is put on its branch by it.

    Examples
    --------
    >>> import kros
    >>> plant = kros.plants.HarmonicDrivePopulation(n_units=2, n_episodes=2, seconds=8.0, seed=3)
    >>> drives = plant.simulate().population
    >>> calibration = kros.identify(drives, refine=False).calibration
    >>> sorted(calibration.units) == list(drives.unit_ids), -3.2 < calibration.lag_rad < 0
    (True, True)
    """

    KIND = "calibration"
    spec: PhaseSpec
    lag_rad: float
    units: Mapping[str, UnitPhase]

    def calibrate(self, segments: Sequence[Segment], unit: str) -> UnitPhase:
        """Calibrate a new unit on the population's branch."""
        return unit_phase(segments, unit, self.spec).on_branch_of(self.lag_rad)


def wrap(angle: float) -> float:
    """Return an angle in [0, 2 pi)."""
    return float(np.mod(angle, 2 * np.pi))


def find_segments(angle: Array, reference: Array, measured: Array, dt: float, spec: PhaseSpec) -> list[Segment]:
    """Find the constant-velocity segments of an episode, signals (n_samples,), and the phase of the error in each."""
    signals = np.array([angle, reference, measured])
    angle, reference, measured = np.where(np.isfinite(signals).all(axis=0), signals, 0.0)
    top = float(np.max(np.abs(reference)))
    if top == 0:
        return []
    constant = np.abs(np.diff(reference, prepend=reference[:1])) < spec.steady * top / len(reference)
    steady = constant & (np.abs(reference) > spec.least_speed * top)
    moving = steady[:-1] & steady[1:]
    relative = reference[:-1][moving] / top
    power = float(relative @ relative)
    per_reference = float(relative @ np.diff(angle)[moving]) / power / (dt * top) if power else 0.0
    edges = np.flatnonzero(np.diff(steady, prepend=False, append=False))
    segments = []
    for start, stop in zip(edges[::2] + round(spec.settle * len(reference)), edges[1::2], strict=True):
        speed = per_reference * float(np.mean(reference[start:stop])) if stop > start else 0.0
        period = 2 * np.pi / (spec.ratio * abs(speed) * dt) if speed else np.inf
        if stop - start >= spec.least_periods * period and period > spec.least_samples:
            segments.append(Segment(speed, _error_phase(spec.ratio * angle[start:stop], -measured[start:stop])))
    return segments


def _error_phase(turn: Array, error: Array) -> float:
    """Phase of the error at the disturbance's frequency, fitted with drift and second harmonic."""
    ramp = np.linspace(-1, 1, turn.size)
    columns = [np.sin(turn), np.cos(turn), np.sin(2 * turn), np.cos(2 * turn), np.ones_like(ramp), ramp, ramp**2]
    along_sin, along_cos = np.linalg.lstsq(np.stack(columns, axis=1), error, rcond=None)[0][:2]
    return float(np.arctan2(along_cos, along_sin))


def unit_phase(segments: Sequence[Segment], unit: str, spec: PhaseSpec) -> UnitPhase:
    """Combine a unit's segments, each direction and speed by itself; needs a speed in both directions."""
    rows = []
    remaining = sorted(segments, key=lambda s: -abs(s.speed))
    while remaining:
        group = [s for s in remaining if abs(s.speed) > (1 - spec.speed_tolerance) * abs(remaining[0].speed)]
        remaining = remaining[len(group) :]
        forward, reverse = ([s for s in group if (s.speed > 0) is ahead] for ahead in (True, False))
        if forward and reverse:
            (psi_f, r_f), (psi_r, r_r) = _circular_mean(forward), _circular_mean(reverse)
            rows.append(((psi_f + psi_r) / 2, (psi_f - psi_r) / 2, min(r_f, r_r), min(len(forward), len(reverse))))
    if not rows:
        ahead = sum(s.speed > 0 for s in segments)
        directions = {"forward": ahead, "reverse": len(segments) - ahead}
        raise IdentificationError(
            f"Phase calibration of unit {unit}: needs constant-velocity segments of equal speed in both directions, "
            f"found {directions}; record such motion, or lift with sine and cosine and no phase parameter."
        )
    phases, lags, concentrations, weights = np.array(rows).T
    best = int(np.argmax(weights))
    # Phases of other speeds are put on the best speed's branch before averaging; their lags differ and are not mixed.
    aligned = phases + np.pi * np.round((phases[best] - phases) / np.pi)
    concentration = float(np.average(concentrations, weights=weights))
    if concentration < spec.least_concentration:
        log.warning("phase calibration of unit %s: its segments agree poorly, concentration %.2f", unit, concentration)
    return UnitPhase(wrap(float(np.average(aligned, weights=weights))), float(lags[best]), concentration, len(segments))


def _circular_mean(segments: Sequence[Segment]) -> tuple[float, float]:
    resultant = np.mean([np.exp(1j * s.phase) for s in segments])
    return float(np.angle(resultant)), float(np.abs(resultant))


def resolve_branches(units: Mapping[str, UnitPhase], pooled: Sequence[str], spec: PhaseSpec) -> PhaseCalibration:
    """Choose the branch of the half sum for the population: within 90 degrees of the mean lag, that in [-pi, 0)."""
    doubled = np.mean([np.exp(2j * units[u].lag_rad) for u in pooled])
    lag = float(np.angle(doubled)) / 2
    lag = lag - np.pi if lag >= 0 else lag
    if np.abs(doubled) < spec.least_concentration:
        text = "phase calibration: lags differ so much (resultant %.2f) that some units may be on the wrong branch"
        log.warning(text, np.abs(doubled))
    return PhaseCalibration(spec, lag, {name: unit.on_branch_of(lag) for name, unit in units.items()})


Task = tuple[Population, Keys, PhaseSpec]


def calibrate(population: Population, facts: RecordingFacts, spec: PhaseSpec, work: Work) -> PhaseCalibration:
    """Calibrate all units on training episodes; one that cannot be calibrated is left out, its reason in the log."""
    tasks = [(population.select([u]), calibration_keys(facts, u), spec) for u in facts.groups]
    recalled = work.recall("calibrate", segments_of, tasks, map(facts.mark, tasks), list[Segment])
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


def segments_of(task: Task) -> list[Segment]:
    """Find the constant-velocity segments of some episodes, in blocks where one is very long."""
    population, keys, spec = task
    names = population.states + population.inputs
    angle, reference = (names.index(n) for n in (spec.angle, spec.reference))
    segments, dt = [], population.sample_period_s
    episodes = map(population.read, keys)
    for values in (part for one in episodes for k in pieces(len(one), _BLOCK) if len(part := one[k]) > 1):
        rate = values[:, names.index(spec.measured)] if spec.measured in names else np.gradient(values[:, angle], dt)
        segments += find_segments(values[:, angle], values[:, reference], rate, dt, spec)
    return segments


def calibration_keys(facts: RecordingFacts, unit: str) -> Keys:
    """Return the episodes that a unit is calibrated on: those of `identify_on`, or of the first condition it has."""
    every = facts.keys("train", unit)
    return facts.keys("train", unit, facts.identify_on) or tuple(k for k in every if k.condition == every[0].condition)


Values = dict[str, dict[str, float]]  # lifting parameters by unit


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
    spec, groups = calibration.spec, {(u, c): keys for u, c, keys in population.groups()}
    several = tuple(k for keys in groups.values() if len(keys) > 1 for k in keys)
    splits = split_episodes(replace(population, episodes=several)).items()
    training = groups | {group: split.train for group, split in splits}  # or the only episode
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
