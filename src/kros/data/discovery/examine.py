"""What looks wrong in recordings, found in one pass before anything is computed: nothing stops at the first of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...core.work import Work
from ..checks import GroupWatch, NonFiniteError, check_episode, copies_among, digest_of
from ..population import EpisodeKey, Population
from ..recording import PERIOD_TOLERANCE, TIME_TOLERANCE, check_increasing

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DiscoveryRule:
    """What recordings are judged by before a study exists."""

    looked_at: int = 15  # files whose first lines say how all are written
    sampled: int = 6  # files whose numbers say what columns are
    pieces: int = 5  # episodes that a single long recording is cut into
    shortest_piece: int = 200  # samples that each of them needs
    gap: float = 10.0  # median steps that a step may take before it is a gap, as in the step `resample`
    bridged: float = 50.0  # median steps of the longest gap that is bridged
    often: float = 0.2  # share of episodes with gaps, from which on gaps are bridged
    slower: float = 1.5  # times the median period, from which on an episode was sampled too slowly


RULE = DiscoveryRule()


@dataclass(frozen=True)
class EpisodeLook:
    """What one episode looks like."""

    key: EpisodeKey
    wrong: str = ""  # why it cannot be used, or nothing
    n_samples: int = 0
    period_s: float = np.nan  # median step of time
    uneven: tuple[float, int] = (0.0, 0)  # largest relative deviation of a step of time, and the sample before it
    gap: tuple[float, int] = (0.0, 0)  # longest step of time, s, where it is a gap, and the sample before it
    nan: str = ""  # where it holds NaN or infinity, or nothing
    digest: str = ""


@dataclass(frozen=True)
class Examined:
    """What all episodes look like."""

    wrong: dict[EpisodeKey, str]  # episodes that cannot be used, with the reason
    doubts: tuple[str, ...]  # what else looks wrong
    resample_s: float | None  # period to resample to, where time is uneven
    nan: tuple[EpisodeKey, ...]  # episodes with NaN or infinity
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)  # usable episodes by unit and condition
    shortest: int = 0  # samples of the shortest of them
    max_gap_s: float | None = None  # longest gap to bridge, where many episodes have gaps
    uneven: tuple[EpisodeKey, int] | None = None  # where time is most uneven


def examine(population: Population, work: Work | None = None) -> Examined:
    """Read every episode once, as it was recorded."""
    tasks = [population.select([u], [c]) for u, c, _ in population.groups()]
    looks = [look for group in (work or Work()).map("look", _look, tasks) for look in group]
    readable = [s for s in looks if not s.wrong]
    median = float(np.median([s.period_s for s in readable])) if readable else np.nan
    gaps = [s.gap[0] for s in readable if s.gap[0] and s.period_s <= RULE.slower * median]
    many = len(gaps) > RULE.often * len(readable)
    bridged = max((g for g in gaps if many and g <= RULE.bridged * median), default=0.0)
    wrong = {s.key: problem for s in looks if (problem := _problem(s, median, bridged))}
    for key, other in copies_among((s.key, s.digest) for s in looks if s.digest and s.key not in wrong):
        wrong[key] = f"a copy of {other}"
    good = [s for s in looks if s.key not in wrong]
    n_bridged = sum(s.gap[0] > 0 for s in good)
    how = f"of up to {bridged:.3g} s: they are bridged by straight lines (max_gap_s)"
    worst = max((s for s in good if s.uneven[0]), key=lambda s: s.uneven, default=None)
    different = any(abs(s.period_s - median) > PERIOD_TOLERANCE * median for s in good)
    return Examined(
        wrong,
        (*([f"{n_bridged} episodes have gaps, {how}"] if n_bridged else []), *(s.nan for s in good if s.nan)),
        resample_s=float(f"{median:.3g}") if worst is not None or different else None,
        nan=tuple(s.key for s in good if s.nan),
        counts=Counter((s.key.unit, s.key.condition) for s in good if not s.nan),
        shortest=min((s.n_samples for s in good), default=0),
        max_gap_s=float(f"{1.01 * bridged:.3g}") if n_bridged else None,
        uneven=None if worst is None else (worst.key, worst.uneven[1]),
    )


def _problem(look: EpisodeLook, median: float, bridged: float) -> str:
    """Return why an episode cannot be used beside the others, or nothing."""
    if not look.wrong and look.period_s > RULE.slower * median:
        return f"sampled every {look.period_s:.3g} s, the others every {median:.3g} s"
    gap, sample = look.gap
    return look.wrong or (f"a gap of {gap:.3g} s after sample {sample}" if gap > bridged else "")


def _look(population: Population) -> list[EpisodeLook]:
    """Look at the episodes of one unit and condition, in a worker."""
    source: Any = population.source
    looks, watch = {}, GroupWatch(population.columns)
    for key in population.episodes:
        looks[key] = EpisodeLook(key, period_s=population.sample_period_s)
        try:
            recording = source.recorded(key)
            check_increasing(recording)
            looks[key] = _timed(replace(looks[key], n_samples=len(recording.values)), recording.time_s)
            check_episode(recording.values, key, population.columns)
            looks[key] = replace(looks[key], digest=digest_of(recording.values))
            watch.add(key, recording.values)
        except NonFiniteError as error:
            looks[key] = replace(looks[key], nan=str(error))
        except DataError as error:
            looks[key] = replace(looks[key], wrong=str(error))
    return list((looks | {key: EpisodeLook(key, problem) for key, problem in watch.wild()}).values())


def _timed(look: EpisodeLook, time: Array | None) -> EpisodeLook:
    """Return a look with its period, and its most uneven step and its longest gap."""
    if time is None or len(time) < 2:
        return look
    steps = np.diff(time)
    period, longest = float(np.median(steps)), int(steps.argmax())
    deviation = np.abs(steps - period) / period
    worst = int(deviation.argmax())
    uneven = (float(deviation[worst]), worst) if deviation[worst] > TIME_TOLERANCE else look.uneven
    gap = (float(steps[longest]), longest) if steps[longest] > RULE.gap * period else look.gap
    return replace(look, period_s=period, uneven=uneven, gap=gap)
