"""All recordings of a population read and checked."""

from kros.data import EpisodeKey, Population
from kros.data.recording import refuse_copies, usable_episodes


def scan_digests(population: Population, on_nan: str = "error") -> list[tuple[EpisodeKey, str]]:
    """The usable episodes with their digests."""
    groups = [usable_episodes(population.select([u], [c]), on_nan) for u, c, _ in population.groups()]
    digests = [(key, digest) for group in groups for key, _, digest in group]
    refuse_copies(digests)
    return digests
