"""Physical units of formulas: products and powers multiply, functions are pure numbers, and what does not follow is left empty."""

import pytest

from kros.lifting import Lifting
from kros.lifting.units import read_unit, write_unit

KNOWN = {"p": "rad", "v": "rad/s", "i": "A", "T": "N·m/A", "u": "V", "z": ""}


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("p*v", "rad²/s"),
        ("100*p", "rad"),
        ("v**2/p", "rad/s²"),
        ("T*i", "N·m"),
        ("p[-1]*i[-2]", "rad·A"),
        ("i**-1", "1/A"),
        ("v/p", "1/s"),
        ("sqrt(v**4)", "rad²/s²"),
        ("abs(v)", "rad/s"),
        ("sin(100*p + q)", "1"),
        ("exp(-p**2)*i", "A"),
        ("sign(v)", "1"),
        ("p + p[-1]", "rad"),
        ("p + v", ""),
        ("p + 1", ""),
        ("sin(p) + 1", "1"),
        ("v**0.5", ""),
        ("q*p", ""),
        ("z*p", ""),
    ],
)
def test_units_follow_from_those_of_the_states(text, unit):
    lifting = Lifting(("p", "v", "i", "T", "z"), (text,), ("q",), ("u",), ("i*u",))
    found = lifting.units(KNOWN)
    assert found[:5] == ("rad", "rad/s", "A", "N·m/A", "")
    powers = [read_unit(u) if u else None for u in (found[5], unit)]
    assert powers[0] == powers[1], found[5]
    assert {*lifting.input_units(KNOWN)[0].split("·")} == {"A", "V"}


@pytest.mark.parametrize(
    ("written", "normal"),
    [
        ("kg m²/s²", "kg·m²/s²"),
        ("1/s", "1/s"),
        ("m/s/s", "m/s²"),
        ("N*m", "N·m"),
        ("m s**-2", "m/s²"),
        ("rad^2", "rad²"),
        ("1", "1"),
        ("%", "%"),
    ],
)
def test_usual_ways_to_write_a_unit_are_read(written, normal):
    assert write_unit(read_unit(written)) == normal


@pytest.mark.parametrize("text", ["", "?!", "V/(m)", "2 rad"])
def test_what_is_no_unit_is_not_known(text):
    assert read_unit(text) is None
