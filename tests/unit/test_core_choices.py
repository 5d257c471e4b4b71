"""A choice given by its name means the same as the member of the enumeration, and another name is refused."""

import pytest

from kros.core import StateSpace, gain
from kros.core.errors import ConfigError
from kros.data import Channel, Role
from kros.evaluate.disturb import Disturbance, Kind
from kros.plants.harmonic_drive.parameters import Loop
from kros.plants.harmonic_drive.population import HarmonicDrivePopulation
from kros.synthesis import Injection, ObserverProblem


def _problem(injection) -> ObserverProblem:
    return ObserverProblem(
        StateSpace([[0.9, 0.1], [0.0, 0.5]], [[1.0], [0.3]], [[1.0, 0.0], [0.0, 1.0]], [[0.0], [0.0]], 0.01),
        [[1.0, 0.0]],
        W_L=gain([[0.1, 0.0], [0.0, 0.1]], 0.01),
        W_R=gain([[1.0, 0.0], [0.0, 1.0]], 0.01),
        input_scale=[1.0],
        output_scale=[1.0, 1.0],
        noise=[0.1],
        form="output_multiplicative",
        injection=injection,
    )


@pytest.mark.parametrize("injection", [Injection.STATE, Injection.INPUT])
def test_the_injection_by_its_name_gives_the_same_problem(injection):
    by_member, by_name = _problem(injection), _problem(injection.value)
    assert by_name.injection is by_member.injection is injection
    assert by_name.injection_matrix.shape == by_member.injection_matrix.shape


def test_every_choice_is_converted_where_it_enters():
    assert Channel("position", "state").role is Role.STATE
    assert Disturbance("dropped", 0.1).kind is Kind.DROPPED
    assert HarmonicDrivePopulation(loop="soft").loop is Loop.SOFT


@pytest.mark.parametrize(
    ("build", "known"),
    [
        (lambda: _problem("everywhere"), "input"),
        (lambda: Channel("position", "everywhere"), "state"),
        (lambda: Disturbance("everywhere", 0.1), "dropped"),
        (lambda: HarmonicDrivePopulation(loop="everywhere"), "soft"),
    ],
)
def test_an_unknown_name_is_refused_with_the_known_ones(build, known):
    with pytest.raises(ConfigError, match=f"'everywhere' is unknown; choose one of .*{known}"):
        build()
