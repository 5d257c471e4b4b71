"""Names, selections and the split."""

from typing import Any

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data import Channel, EpisodeKey, Population, Role, from_arrays, split_episodes

CHANNELS = (Channel("x", Role.STATE, measured=True), Channel("u", Role.INPUT))


def population(counts: dict[tuple[str, str], int]) -> Population:
    rng = np.random.default_rng(0)
    episodes = {EpisodeKey(u, c, str(e)): rng.standard_normal((5, 2)) for (u, c), n in counts.items() for e in range(n)}
    return from_arrays(episodes, CHANNELS, 0.1)


def test_keys_select_and_groups_agree() -> None:
    whole = population({("a", "hot"): 3, ("a", "cold"): 2, ("b", "hot"): 2})
    assert [(u, c, len(keys)) for u, c, keys in whole.groups()] == [("a", "cold", 2), ("a", "hot", 3), ("b", "hot", 2)]
    for unit, condition, keys in whole.groups():
        assert whole.keys(unit, condition) == keys == tuple(k for k in whole.keys(unit) if k.condition == condition)
    assert whole.keys("z", "hot") == ()
    part = whole.select(units=["a"], conditions=["hot"])
    assert (part.unit_ids, part.conditions, len(part.episodes)) == (("a",), ("hot",), 3)
    np.testing.assert_array_equal(part.read(part.episodes[0]), whole.read(part.episodes[0]))
    with pytest.raises(DataError):
        part.read(EpisodeKey("b", "hot", "0"))


@pytest.mark.parametrize(
    ("n", "test"), [(20, ["18", "19"]), (10, ["9"]), (2, ["1"]), (19, ["18"]), (30, ["27", "28", "29"])]
)
def test_split_by_default(n: int, test: list[str]) -> None:
    split = split_episodes(population({("a", "hot"): n}))["a", "hot"]
    assert [k.episode for k in split.test] == test
    assert [k.episode for k in (*split.train, *split.test)] == [str(i) for i in range(n)]


def test_split_by_name_and_its_refusals() -> None:
    whole: Any = population({("a", "hot"): 4, ("b", "hot"): 4})
    assert {tuple(k.episode for k in s.test) for s in split_episodes(whole, ["0", "2"]).values()} == {("0", "2")}
    with pytest.raises(DataError, match="leaves 4 for training and 0 for testing"):
        split_episodes(whole, ["7"])
    with pytest.raises(DataError, match="leaves 0 for training"):
        split_episodes(whole, ["0", "1", "2", "3"])
    with pytest.raises(DataError, match=r"unit a \(hot\) into training and test needs at least two, found 1"):
        split_episodes(population({("a", "hot"): 1}))
