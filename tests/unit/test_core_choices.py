"""A choice given by its name means the same as the member of the enumeration, and another name is refused."""

import pytest

from kros.core.errors import ConfigError
from kros.data import Channel, Role
from kros.plants.harmonic_drive.dynamics import Loop
from kros.plants.harmonic_drive.population import HarmonicDrivePopulation


@pytest.mark.parametrize(
    ("build", "field", "member"),
    [
        (lambda name: Channel("position", name), "role", Role.STATE),
        (lambda name: HarmonicDrivePopulation(loop=name), "loop", Loop.SOFT),
    ],
)
def test_every_choice_is_converted_where_it_enters(build, field, member):
    assert getattr(build(member.value), field) is member
    with pytest.raises(ConfigError, match=f"'everywhere' is unknown; choose one of .*{member.value}"):
        build("everywhere")
