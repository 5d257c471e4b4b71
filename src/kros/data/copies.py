"""Episodes that were recorded once and are there twice: they put test episodes into training, and one machine's data into another.

Every episode leaves a print when it is read: a digest of all its samples, and the smallest hashes of its stretches of samples (a bottom-k
sketch, A. Broder, On the resemblance and containment of documents, 1997). Episodes that share samples share these hashes, in the ratio of
what they share, wherever the common part lies in either. A print takes half a kilobyte however long the episode is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .population import Channel, EpisodeKey, Role
from .recording import title

STRETCH = 16  # samples that two episodes have to share bit by bit, one behind the other, to have something in common
KEPT = 64  # hashes an episode
SHARED = 0.25  # of the hashes from which on an episode counts as a copy in part
_LOOKED_AT = 8 * KEPT  # smallest hashes among which those of moving machines are sought
_PRIME, _MIX = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9)


@dataclass(frozen=True, eq=False)
class Print:
    """What one episode is recognised by."""

    digest: bytes  # of all samples
    hashes: npt.NDArray[np.uint64]  # shape (at most KEPT,); the smallest hashes of its stretches


def print_of(values: npt.NDArray[np.float64], channels: Sequence[Channel]) -> Print:
    """Return the print of an episode."""
    values = np.ascontiguousarray(values) + 0.0  # one zero
    found = sha256(repr(values.shape).encode())
    found.update(values.data)
    digest = found.digest()
    states = [i for i, c in enumerate(channels) if c.role is Role.STATE]
    if len(values) <= STRETCH:
        return Print(digest, np.zeros(0, np.uint64))
    hashes = _stretches(values)
    smallest = np.argpartition(hashes, min(_LOOKED_AT, len(hashes)) - 1)[:_LOOKED_AT]
    signals = np.ascontiguousarray(values[:, states].T)
    changes = np.zeros((len(states), len(values)), np.int32)
    np.cumsum(signals[:, 1:] != signals[:, :-1], axis=1, dtype=np.int32, out=changes[:, 1:])
    moving = (changes[:, smallest + STRETCH - 1] - changes[:, smallest]).min(axis=0) >= STRETCH // 2
    return Print(digest, np.unique(hashes[smallest[moving]])[:KEPT])


def copies_among(prints: Iterable[tuple[EpisodeKey, Print]]) -> Iterator[tuple[EpisodeKey, EpisodeKey, float]]:
    """Yield the episodes that are copies of earlier ones with these, and the share of samples that both have: 1 for a whole copy."""
    prints = list(prints)
    whole: dict[bytes, EpisodeKey] = {}
    holders: dict[int, EpisodeKey] = {}
    for (key, found), repeated in zip(prints, _repeated([found.hashes for _, found in prints]), strict=True):
        if found.digest in whole:
            yield key, whole[found.digest], 1.0
            continue
        common = Counter(holders[h] for h in repeated if h in holders).most_common(1)
        if common and common[0][1] >= SHARED * KEPT:
            yield key, common[0][0], min(common[0][1] / len(found.hashes), 0.99)
        whole[found.digest] = key
        for h in repeated:
            holders.setdefault(h, key)


def _repeated(hashes: Sequence[npt.NDArray[np.uint64]]) -> list[list[int]]:
    """Return of every episode's hashes those that another one has too: no others can be shared, and there are few."""
    if not hashes:
        return []
    flat = np.concatenate(hashes)
    _, place, count = np.unique(flat, return_inverse=True, return_counts=True)
    often = count[place] > 1
    ends = np.cumsum([len(own) for own in hashes])[:-1]
    return [own[some].tolist() for own, some in zip(hashes, np.split(often, ends), strict=True)]


def refuse_copies(prints: Iterable[tuple[EpisodeKey, Print]]) -> None:
    """Refuse episodes that are copies of others, whole or in a good part."""
    for key, other, shared in copies_among(prints):
        if shared >= 1:
            raise DataError(
                f"{title(key)} is a copy of {other}, sample by sample; a copy leaks test episodes into training and makes units look "
                "alike, so remove one of them."
            )
        raise DataError(
            f"{title(key)} and {other} share about {100 * shared:.0f} % of their samples in all channels; "
            "recordings never repeat bit by bit, so remove one of them, or cut the common part."
        )


def _stretches(values: npt.NDArray[np.float64]) -> npt.NDArray[np.uint64]:
    """One hash a stretch of samples, shape (n_samples - STRETCH + 1,)."""
    with np.errstate(over="ignore"):
        rows = np.zeros(len(values), np.uint64)
        for column in values.view(np.uint64).T:
            rows = _mixed(rows * _PRIME + column)
        length = 1
        while length < STRETCH:  # twice as long every time
            rows = _mixed(rows[:-length] * _PRIME + rows[length:])
            length *= 2
        return rows


def _mixed(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    x = x ^ (x >> np.uint64(30))
    x *= _MIX
    x ^= x >> np.uint64(27)
    return x
