"""What looks wrong in recordings, found in one pass before anything is computed: nothing stops at the first of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...core.work import Work
from ..alerts import period_alerts
from ..checks import MIN_SAMPLES, WildWatch, is_constant
from ..copies import copies_among, digest_of
from ..population import Channel, EpisodeKey, Population, Role
from ..prepare import PreparedSource
from ..recording import TIME_TOLERANCE, Recording, title, usable

Array = npt.NDArray[np.float64]
GAP = 10.0  # median steps that a step may take before it counts as a gap, as in the step `resample`
MANY, BRIDGED = (
    5,
    50.0,
)  # where a fifth of the episodes or more have gaps, those of up to so many median steps are bridged
_LONG_REST = 0.2  # of an episode, from which on a signal that stands still while others move is worth a word
_SLOWER = 1.5


@dataclass(frozen=True)
class EpisodeLook:
    """What one episode looks like."""

    key: EpisodeKey
    wrong: str = ""  # why it cannot be used, or nothing
    doubts: tuple[str, ...] = ()  # what is odd about it
    n_samples: int = 0
    period_s: float = np.nan  # median step of time; NaN where there is no column of time
    uneven: tuple[float, int] | None = (
        None  # largest relative deviation of a step of time, and the sample before it, where time is uneven
    )
    nan: bool = False
    gap: tuple[float, int] | None = (
        None  # or None; Longest step of time, s, where it is a gap, and the sample before it
    )
    digest: str = ""
    alerts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Examined:
    """What all episodes look like."""

    wrong: dict[EpisodeKey, str]  # episodes that cannot be used, with the reason
    doubts: tuple[str, ...]  # what else looks wrong
    resample_s: float | None  # period to resample to, where time is uneven
    nan: tuple[EpisodeKey, ...]  # episodes with NaN or infinity
    counts: Counter[tuple[str, str]] = field(
        default_factory=Counter
    )  # episodes that can be used, by unit and condition
    shortest: int = 0  # samples of the shortest of them
    max_gap_s: float | None = None  # longest gap to bridge, where many episodes have gaps
    uneven: tuple[EpisodeKey, int] | None = None  # where time is most uneven


def examine(population: Population, work: Work | None = None) -> Examined:
    """Read every episode once, as it was recorded."""
    tasks = [population.select([u], [c]) for u, c, _ in population.groups()]
    seen = [s for found in (work or Work()).map("look", _look, tasks) for s in found]
    wrong = {s.key: s.wrong for s in seen if s.wrong}
    good = [s for s in seen if not s.wrong]
    median = float(np.median([s.period_s for s in good])) if good else np.nan
    slow = {
        s.key: f"sampled every {s.period_s:.3g} s, the others every {median:.3g} s"
        for s in good
        if s.period_s > _SLOWER * median
    }
    wrong |= slow
    broken = {s.key: s.gap for s in good if s.gap is not None and s.key not in wrong}
    bridged = (
        max((g for g, _ in broken.values() if g <= BRIDGED * median), default=0.0)
        if MANY * len(broken) > len(good)
        else 0.0
    )
    wrong |= {key: f"a gap of {g:.3g} s after sample {k}" for key, (g, k) in broken.items() if g > bridged}
    good = [s for s in good if s.key not in wrong]
    for key, other in copies_among((s.key, s.digest) for s in good if s.digest):
        wrong.setdefault(key, f"a copy of {other}")
    good = [s for s in good if s.key not in wrong]
    different = any(abs(s.period_s - median) > 1e-4 * median for s in good)
    resample = float(f"{median:.3g}") if any(s.uneven is not None for s in good) or different else None
    n_bridged = sum(s.gap is not None for s in good)
    told = (
        [f"{n_bridged} episodes have gaps, of up to {bridged:.3g} s: they are bridged by straight lines (max_gap_s)"]
        if n_bridged
        else []
    )
    doubts = told + [d for s in good for d in s.doubts] + list(dict.fromkeys(a for s in good for a in s.alerts))
    max_gap = float(f"{1.01 * bridged:.3g}") if n_bridged else None
    counts = Counter((s.key.unit, s.key.condition) for s in good if not s.nan)
    shortest = min((s.n_samples for s in good), default=0)
    worst = max((s for s in good if s.uneven is not None), key=lambda s: s.uneven or (0.0, 0), default=None)
    uneven = None if worst is None or worst.uneven is None else (worst.key, worst.uneven[1])
    return Examined(
        wrong, tuple(doubts), resample, tuple(s.key for s in good if s.nan), counts, shortest, max_gap, uneven
    )


def _look(population: Population) -> list[EpisodeLook]:
    """Look at the episodes of one unit and condition, in a worker."""
    source: Any = population.source
    looks, wild = {}, WildWatch(population.columns)
    for key in population.episodes:
        try:
            recording = source.recordings(key) if isinstance(source, PreparedSource) else Recording(key, source(key))
            looks[key] = _looked(recording, population.columns, population.sample_period_s, not looks)
            if not looks[key].wrong and not looks[key].nan:
                wild.add(key, recording.values)
        except DataError as error:
            looks[key] = EpisodeLook(key, str(error))
    return list((looks | {key: EpisodeLook(key, problem) for key, problem in wild.find()}).values())


def _looked(recording: Recording, channels: Sequence[Channel], period_s: float, first: bool) -> EpisodeLook:
    """Look at one episode as recorded."""
    key, values, time = recording.key, recording.values, recording.time_s
    n = len(values)
    if n < MIN_SAMPLES:
        return EpisodeLook(key, f"has {n} samples", n_samples=n)
    period, gap = period_s, None
    uneven: tuple[float, int] | None = None
    if time is not None:
        steps = np.diff(time)
        backwards = np.flatnonzero(~(steps > 0))
        if backwards.size:
            k = int(backwards[0])
            return EpisodeLook(
                key,
                f"time stands still or runs back at sample {k} ({time[k]:g} s, then {time[k + 1]:g} s), {backwards.size} times",
                n_samples=n,
            )
        period = float(np.median(steps))
        worst = int(steps.argmax())
        gap = (float(steps[worst]), worst) if steps[worst] > GAP * period else None
        deviation = np.abs(steps - period) / period
        uneven = (float(deviation.max()), int(deviation.argmax())) if deviation.max() > TIME_TOLERANCE else None
    if not usable(values).all():
        bad = np.count_nonzero(~usable(values), axis=0)
        names = ", ".join(f"{c.name!r} ({count})" for c, count in zip(channels, bad, strict=True) if count)
        return EpisodeLook(
            key, "", (f"{title(key)}: no number in some samples of {names}",), n, period, uneven, True, gap
        )
    still = [i for i, c in enumerate(channels) if c.role is Role.STATE and is_constant(values[:, i])]
    if still and len(still) < sum(not is_constant(values[:, i]) or i in still for i in range(len(channels))):
        stuck = channels[still[0]].name
        return EpisodeLook(
            key,
            f"state {stuck!r} stays at {values[0, still[0]]:g} in all samples while others move: a stuck sensor",
            n_samples=n,
        )
    alerts = period_alerts(values, channels, period) if first else ()
    return EpisodeLook(
        key, "", tuple(_rests(key, values, channels)), n, period, uneven, False, gap, digest_of(values), alerts
    )


def _rests(key: EpisodeKey, values: Array, channels: Sequence[Channel]) -> list[str]:
    """Say where a state stands still for long while other states move a good part of their range."""
    states = [i for i, c in enumerate(channels) if c.role is Role.STATE]
    ranges, found = np.ptp(values, axis=0), []
    for i in states:
        changes = np.flatnonzero(np.diff(values[:, i]) != 0)
        ends = np.concatenate([[-1], changes, [len(values) - 1]])
        longest = int(np.diff(ends).argmax())
        start, stop = int(ends[longest]) + 1, int(ends[longest + 1]) + 1
        if stop - start < max(50, _LONG_REST * len(values)):
            continue
        moving = [channels[j].name for j in states if j != i and np.ptp(values[start:stop, j]) > 0.2 * ranges[j] > 0]
        if moving:
            name = channels[i].name
            found.append(
                f"{title(key)}: {name!r} stays at {values[start, i]:g} from sample {start} to {stop - 1} while {', '.join(moving)} move"
            )
    return found
