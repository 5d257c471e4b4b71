"""Bounds of values and slopes: tight for simple functions, infinite where a function is, never below a sample."""

import itertools

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy.core.evalf import PrecisionExhausted

from kros.core.errors import ConfigError
from kros.lifting import Lifting
from kros.lifting.formula import Formula
from kros.lifting.intervals import bounds_of
from kros.lifting.program import Program

INF = np.inf


def bounds(text, **box):
    lower, upper = bounds_of([Formula(text, ("x", "y", "q")).expression], box)
    return float(lower[0]), float(upper[0])


@pytest.mark.parametrize(
    ("text", "box", "expected"),
    [
        ("sin(x)", {}, (-1, 1)),
        ("sin(x)", {"x": (0, 1)}, (0, np.sin(1))),
        ("sin(x)", {"x": (1, 2)}, (np.sin(1), 1)),
        ("sin(x)", {"x": (100, 101)}, (np.sin(100), np.sin(101))),
        ("sin(x)", {"x": (98, 101)}, (-1, np.sin(101))),
        ("cos(x)", {"x": (-1, 2)}, (np.cos(2), 1)),
        ("cos(x)", {"x": (3, 4)}, (-1, np.cos(4))),
        ("tan(x)", {"x": (-1, 1)}, (-np.tan(1), np.tan(1))),
        ("tan(x)", {"x": (1, 2)}, (-INF, INF)),
        ("tan(x)", {"x": (0, 10)}, (-INF, INF)),
        ("exp(x)", {}, (0, INF)),
        ("exp(-x**2)", {"x": (-1, 2)}, (np.exp(-4), 1)),
        ("log(x)", {"x": (1, 3)}, (0, np.log(3))),
        ("log(x)", {"x": (0, 3)}, (-INF, np.log(3))),
        ("log(x)", {"x": (-2, -1)}, (-INF, INF)),
        ("log(x)", {"x": (0, 0)}, (-INF, -INF)),
        ("sqrt(x)", {"x": (4, 9)}, (2, 3)),
        ("sqrt(x)", {"x": (-4, 9)}, (-INF, INF)),
        ("tanh(x)", {}, (-1, 1)),
        ("atan(x)", {}, (-np.pi / 2, np.pi / 2)),
        ("abs(x)", {"x": (-3, 2)}, (0, 3)),
        ("sign(x)", {"x": (-3, 2)}, (-1, 1)),
        ("sign(x)", {"x": (1, 2)}, (1, 1)),
        ("x**2", {"x": (-3, 2)}, (0, 9)),
        ("x**3", {"x": (-3, 2)}, (-27, 8)),
        ("x**-2", {"x": (-3, 2)}, (1 / 9, INF)),
        ("1/x", {"x": (-3, 2)}, (-INF, INF)),
        ("1/x", {"x": (0, 2)}, (0.5, INF)),
        ("1/x", {"x": (-2, 0)}, (-INF, -0.5)),
        ("x**1.5", {"x": (1, 4)}, (1, 8)),
        ("x*y", {"x": (-3, 2), "y": (-1, 5)}, (-15, 10)),
        ("x*y", {"x": 0}, (0, 0)),
        ("x - y", {}, (-INF, INF)),
        ("x/y", {"x": (1, 2), "y": (4, 8)}, (1 / 8, 1 / 2)),
    ],
)
def test_simple_functions_have_tight_bounds(text, box, expected):
    np.testing.assert_allclose(bounds(text, **box), expected, rtol=1e-9, atol=1e-15)


def test_pieces_tighten_what_appears_twice():
    low, high = bounds("x - x**2", x=(0, 1))  # the range is [0, 1/4]; without pieces [-1, 1]
    assert -1e-3 < low <= 0
    assert 0.25 <= high < 0.2505


def test_what_underflows_is_not_bounded_away_from_zero():
    assert bounds("-1/x**2", x=1.4e-254)[0] == -INF
    low, high = bounds("x*y", x=1e-200, y=1e-200)
    assert low == 0 < high
    assert bounds("exp(x)", x=-1000.0)[1] > 0


def test_jumps_and_roots_have_no_bound():
    lifting = Lifting(("x",), ("sign(x)", "sqrt(x)", "abs(x)", "1/x"))
    lower, upper = lifting.slope_bounds({"x": (-1, 1)})
    assert upper[:2].tolist() == [[INF], [INF]]
    assert (lower[2, 0], upper[2, 0]) == pytest.approx((-1, 1))
    assert lower[3, 0] == -INF
    assert lifting.slope_bounds({"x": (1, 2)})[1][0, 0] == 0


def test_a_range_the_wrong_way_round_is_refused():
    with pytest.raises(ConfigError, match=r"range of 'x' is \[1, -1\]"):
        bounds("sin(x)", x=(1, -1))
    with pytest.raises(ConfigError, match="range of 'x'"):
        bounds("sin(x)", x=(np.nan, 1))


LEAVES = st.sampled_from(["x", "y", "q", "0.5", "2", "-1.25", "3"])


def grow(inner):
    functions = st.sampled_from(["sin", "cos", "tanh", "atan", "abs", "exp", "sign", "sqrt", "log", "tan"])
    return st.one_of(
        st.tuples(functions, inner).map("{0[0]}({0[1]})".format),
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/"]), inner).map("({0[0]} {0[1]} {0[2]})".format),
        st.tuples(inner, st.sampled_from(["2", "3", "-1", "-2", "0.5"])).map("({0[0]})**{0[1]}".format),
    )


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    text=st.recursive(LEAVES, grow, max_leaves=5),
    middle=st.tuples(*[st.floats(-3, 3)] * 3),
    half=st.tuples(*[st.floats(0, 2)] * 3),
)
def test_no_sample_escapes(text, middle, half):
    """Where a function is not a real number there is nothing to hold."""
    try:
        formula = Formula(text, ("x", "y", "q"))
        Program.of([formula.expression])
    except ConfigError:
        return
    box = {name: (m - h, m + h) for name, m, h in zip("xyq", middle, half, strict=True)}
    rng = np.random.default_rng(0)
    values = {name: np.concatenate([rng.uniform(low, high, 300), [low, high]]) for name, (low, high) in box.items()}
    derivatives = [formula.derivative(name) for name in "xyq"]
    for expression in [formula.expression, *derivatives]:
        try:
            program = Program.of([expression])
        except ConfigError:
            continue
        with np.errstate(all="ignore"):
            found = np.asarray(program.run(values)[0], dtype=float)
        lower, upper = bounds_of([expression], box)
        found = found[~np.isnan(found)]
        slack = 1e-9 * np.maximum(1, np.abs(np.where(np.isfinite(found), found, 1)))  # log(0) is in its place, too
        assert np.all((found >= lower - slack) & (found <= upper + slack)), (text, expression)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    text=st.recursive(LEAVES, grow, max_leaves=4),
    middle=st.tuples(*[st.floats(-3, 3)] * 3),
    half=st.sampled_from([0.0, 1e-12, 1e-6, 1e-2]),
)
def test_bounds_hold_in_exact_arithmetic(text, middle, half):
    """Values in 60 digits lie between the bounds, without any slack, where large terms cancel too."""
    try:
        formulas = [
            Formula(cancelling, ("x", "y", "q"))
            for cancelling in (text, f"1e15*(sin({text}) - ({text}))", f"1e18*tanh(40*({text}))")
        ]
        trees = [tree for formula in formulas for tree in (formula.expression, formula.derivative("x"))]
    except ConfigError:
        return
    box = {name: (m - half, m + half) for name, m in zip("xyq", middle, strict=True)}
    for tree in trees:
        if tree.has(sp.zoo, sp.nan, sp.DiracDelta):
            continue
        try:
            lower, upper = bounds_of([tree], box)
        except ConfigError:
            continue
        symbols = list(tree.free_symbols)
        for corner in set(itertools.product(*(box[symbol.name] for symbol in symbols))):
            values = zip(symbols, map(sp.Rational, corner), strict=True)
            try:
                exact = tree.subs(dict(values)).evalf(60, maxn=200, strict=True)
            except PrecisionExhausted:  # two hundred digits do not tell it from zero
                continue
            if exact.is_real and exact.is_finite:
                assert sp.Float(lower[0], 60) <= exact <= sp.Float(upper[0], 60), (text, tree, corner)
