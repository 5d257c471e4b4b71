"""A choice given by its name means the same as the member of the enumeration, and another name is refused."""

import pytest

from kros.core.errors import ConfigError
from kros.data import Channel, Role
from kros.plants.harmonic_drive.population import HarmonicDrivePopulation


def test_every_choice_is_converted_where_it_enters():
    assert Channel("position", "state").role is Role.STATE
    with pytest.raises(ConfigError, match=r"'everywhere' is unknown; choose one of .*state"):
        Channel("position", "everywhere")
    with pytest.raises(ConfigError, match="loop 'everywhere' should be one of stiff, soft"):
        HarmonicDrivePopulation(loop="everywhere")
