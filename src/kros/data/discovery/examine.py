"""What looks wrong in recordings, found in one pass before anything is computed: nothing stops at the first of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...core import DataError, Work, frozen
from ..population import EpisodeKey, Population
from ..recording import GroupWatch, NonFiniteError, check_episode, check_increasing, copies_among, digest_of, usable


@frozen
class DiscoveryRule:
    """What recordings are judged by before a study exists."""

    rows: int = 60  # first rows of numbers that are looked at closely
    spread: int = 200  # further lines, spread over the head: machines rest at first, and zeros have no decimal point
    above: int = 20  # lines that may stand before the header
    looked_at: int = 15  # files whose first lines say how all are written
    sampled: int = 6  # files whose numbers say what columns are
    pieces: int = 5  # episodes that a single long recording is cut into
    shortest_piece: int = 200  # samples that each of them needs


RULE = DiscoveryRule()


@frozen
class EpisodeLook:
    """What one episode looks like."""

    key: EpisodeKey
    wrong: str = ""  # why it cannot be used, or nothing
    n_samples: int = 0  # that can be used
    period_s: float = np.nan  # typical step of time
    uneven: tuple[float, int] = (0.0, 0)  # largest relative deviation of a step of time, and the sample before it
    nan: str = ""  # where it holds NaN or infinity, or nothing
    digest: str = ""


def examine(population: Population, work: Work) -> list[EpisodeLook]:
    """Read every episode once, as it was recorded, and say what is wrong with it alone or beside the others."""
    tasks = [population.select([u], [c]) for u, c, _ in population.groups()]
    looks = [look for group in work.map("look", _look, tasks) for look in group]
    copies = dict(copies_among((s.key, s.digest) for s in looks if s.digest and not s.wrong))
    return [replace(s, wrong=f"a copy of {copies[s.key]}") if s.key in copies else s for s in looks]


def _look(population: Population) -> list[EpisodeLook]:
    """Look at the episodes of one unit and condition, in a worker."""
    source: Any = population.source
    looks, watch = {}, GroupWatch(population.columns)
    for key in population.episodes:
        try:
            recording = source.recordings(key)
            values, time = recording.values, recording.time_s
            check_increasing(recording)
            period, deviation = population.sample_period_s, np.zeros(1)
            if time is not None and len(time) > 1:
                far = min(100, len(time) // 2)  # steps at once: single ones may be rounded
                period = float(np.median(time[far:] - time[:-far])) / far
                deviation = np.abs(np.diff(time) / period - 1)
            look = EpisodeLook(key, "", len(values), period, (float(deviation.max()), int(deviation.argmax())))
            check_episode(values, key, population.columns)
            looks[key] = replace(look, digest=digest_of(values))
            watch.add(key, values)
        except NonFiniteError as error:
            count = int(usable(values).all(axis=1).sum())
            looks[key] = replace(look, nan=str(error), n_samples=count) if count else EpisodeLook(key, str(error))
        except DataError as error:
            looks[key] = EpisodeLook(key, str(error))
    return list((looks | {key: EpisodeLook(key, problem) for key, problem in watch.wild()}).values())
