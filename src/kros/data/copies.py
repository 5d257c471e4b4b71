"""Episodes that were recorded once and are there twice: they put test episodes into training, and one machine's data into another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from hashlib import sha256

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .population import EpisodeKey
from .recording import title


def digest_of(values: npt.NDArray[np.float64]) -> str:
    """Return the digest of all samples of an episode, shape (n_samples, n_channels)."""
    values = np.ascontiguousarray(values) + 0.0  # one zero
    found = sha256(repr(values.shape).encode())
    found.update(values.data)
    return found.hexdigest()


def copies_among(digests: Iterable[tuple[EpisodeKey, str]]) -> Iterator[tuple[EpisodeKey, EpisodeKey]]:
    """Yield the episodes that are copies of earlier ones, with these."""
    first: dict[str, EpisodeKey] = {}
    for key, digest in digests:
        if first.setdefault(digest, key) != key:
            yield key, first[digest]


def refuse_copies(digests: Iterable[tuple[EpisodeKey, str]]) -> None:
    """Refuse episodes that are copies of others."""
    for key, other in copies_among(digests):
        raise DataError(
            f"{title(key)} is a copy of {other}, sample by sample; a copy leaks test episodes into training and makes units look "
            "alike, so remove one of them."
        )
