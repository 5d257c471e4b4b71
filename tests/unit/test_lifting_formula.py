"""Formulas: what is read, what is refused, and that evaluation, derivative and C agree with NumPy."""

import numpy as np
import pytest

from kros.core.errors import ConfigError, DimensionError
from kros.lifting import Lifting
from kros.lifting.formula import Formula, parse

NAMES = ("position", "velocity", "phase")


@pytest.mark.parametrize(
    ("text", "reference"),
    [
        ("sin(100*position + phase)", lambda p, v, q: np.sin(100 * p + q)),
        ("position**2 * velocity - 3.5", lambda p, v, q: p**2 * v - 3.5),
        ("-abs(velocity)/(1 + position**2)", lambda p, v, q: -np.abs(v) / (1 + p**2)),
        ("tanh(velocity/0.05)", lambda p, v, q: np.tanh(v / 0.05)),
        ("exp(-position**2/2)*cos(pi*phase)", lambda p, v, q: np.exp(-(p**2) / 2) * np.cos(np.pi * q)),
        ("sqrt(1 + position**2) + sign(position)", lambda p, v, q: np.sqrt(1 + p**2) + np.sign(p)),
        ("log(2 + velocity**2) + atan(phase)", lambda p, v, q: np.log(2 + v**2) + np.arctan(q)),
    ],
)
def test_evaluation_agrees_with_numpy(text, reference):
    p, v, q = np.random.default_rng(0).normal(size=(3, 50))
    found = Formula(text, NAMES).evaluate({"position": p, "velocity": v, "phase": q})
    np.testing.assert_allclose(found, reference(p, v, q), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "position.real",
        "lambda: 1",
        "[x for x in (1,)]",
        "position if velocity else 0",
        "position**velocity",
        "position**1000",
        "unknown + 1",
        "gamma(position)",
        "sin(position, velocity)",
        "sin(position=1)",
        "True + position",
        "1j*position",
        "position = 1",
    ],
)
def test_everything_else_is_refused(text):
    with pytest.raises(ConfigError, match="Formula"):
        parse(text, NAMES)


def test_separation_rebuilds_the_lifting_for_any_phase():
    lifting = Lifting(
        ("position", "velocity"),
        ("sin(100*position + phase)", "2*cos(position - 3*phase)*velocity", "velocity**2"),
        ("phase",),
    )
    x = np.random.default_rng(2).normal(size=(30, 2))
    phase = np.random.default_rng(3).uniform(0, 2 * np.pi, 30)
    separation = lifting.separation
    rebuilt = np.einsum("kij,kj->ki", separation.matrix({"phase": phase}), separation.evaluate(x))
    np.testing.assert_allclose(rebuilt, lifting.lift(x, {"phase": phase})[:, 2:], atol=1e-12)


def test_values_that_do_not_fit_a_lifting_are_refused():
    with pytest.raises(DimensionError, match="parameter values for"):
        Lifting(("position",), ("sin(position + phase)",), ("phase",)).lift(np.zeros((2, 1)))
    with pytest.raises(DimensionError, match="expected 1 entries"):
        Lifting(("position",)).lift(np.zeros((2, 3)))
