"""What looks wrong in recordings, found in one pass before anything is computed: nothing stops at the first of it."""

from dataclasses import replace
from typing import Any

import numpy as np

from ...core import Array, DataError, Work, frozen
from ..population import EpisodeKey, Population
from ..recording import CHECK, GroupWatch, check_episode, check_increasing, copies_among, digest_of, usable
from ..steps import GAP, longest_stretch


@frozen
class DiscoveryRule:
    """What recordings are judged by before a study exists."""

    rows: int = 60  # first rows of numbers that are looked at closely
    spread: int = 200  # further lines, spread over the head: machines rest at first, and zeros have no decimal point
    above: int = 20  # lines that may stand before the header
    looked_at: int = 15  # files whose first lines say how all are written
    sampled: int = 6  # files whose numbers say what columns are
    pieces: int = 5  # episodes that a single long recording is cut into, at most
    shortest_piece: int = 200  # samples of each of them, where there are more than two


RULE = DiscoveryRule()


@frozen
class EpisodeLook:
    """What one episode looks like."""

    key: EpisodeKey
    wrong: str = ""  # why it cannot be used, or nothing
    n_samples: int = 0  # that can be used, up to a gap that is too long to be bridged
    lost: int = 0  # behind such gaps
    period_s: float = np.nan  # typical step of time
    uneven: tuple[float, int] = (0.0, 0)  # largest relative deviation of a step of time, and the sample before it
    nan: bool = False  # whether it holds NaN or infinity
    digest: str = ""


def examine(population: Population, fewest: int, work: Work) -> list[EpisodeLook]:
    """Read every episode once, as it was recorded, and say what is wrong with it alone or beside the others."""
    tasks = [population.select([u], [c]) for u, c, _ in population.groups()]
    looks = [look for group in work.map("look", _look, tasks) for look in group]
    copies = dict(copies_among((s.key, s.digest) for s in looks if s.digest and not s.wrong))
    median = np.median([s.period_s for s in looks if not s.wrong] or [np.nan])
    return [replace(s, wrong=s.wrong or _doubts(s, fewest, float(median), copies.get(s.key))) for s in looks]


def _doubts(look: EpisodeLook, fewest: int, period_s: float, copy: EpisodeKey | None) -> str:
    """Return why an episode that can be read cannot be used beside the others, or nothing."""
    if copy is not None:
        return f"a copy of {copy}"
    if look.n_samples < fewest:
        return f"it has {look.n_samples} samples that can be used, and kros run needs {fewest}"
    if not 1 / CHECK.ratio < look.period_s / period_s < CHECK.ratio:
        return f"its sampling period is {look.period_s:g} s, that of most is {period_s:g} s; check its column of time"
    return ""


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
                period = typical_period(time)
                deviation = np.abs(np.diff(time) / period - 1)
            usable_s = np.asarray(recording.usable(period).time_s)
            start, stop = longest_stretch(np.diff(usable_s) > GAP * period)
            whole = usable(values).all(axis=1)
            check_episode(values, key, population.columns, gaps=bool(whole.any()))
            looks[key] = EpisodeLook(
                key,
                n_samples=stop - start,
                lost=len(usable_s) - (stop - start),
                period_s=period,
                uneven=(float(deviation.max()), int(deviation.argmax())),
                nan=not whole.all(),
                digest=digest_of(values),
            )
            if whole.all():
                watch.add(key, values)
        except DataError as error:
            looks[key] = EpisodeLook(key, str(error))
    return list((looks | {key: EpisodeLook(key, problem) for key, problem in watch.wild()}).values())


def typical_period(time: Array) -> float:
    """Return the sampling period: of many steps at once, since single ones may be rounded, if no rows are lost in them.

    Rounding and jitter make many steps as uneven as one; rows that are lost here and there add up.
    """
    far = min(CHECK.steps, len(time) // 2)
    step, steps = np.diff(time), time[far:] - time[:-far]
    uneven, together = (float(np.ptp(np.quantile(each, CHECK.spread))) for each in (step, steps))
    return float(np.median(step)) if together > 2 * uneven else float(np.median(steps)) / far
