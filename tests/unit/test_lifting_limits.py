"""Formulas without end, or that are not finite, are refused at once; slopes know where a function jumps."""

import numpy as np
import pytest

from kros.core.errors import ConfigError
from kros.core.lti import gain
from kros.lifting import Lifting, polynomials
from kros.lifting.families import check_family
from kros.lifting.formula import Formula
from kros.observer import Observer, ReliftStatus, relift_certificate
from kros.synthesis import Injection

ENDLESS = {
    "powers of powers": "((((9**64)**64)**64)**64)*x",
    "powers of a fraction near one": "((10**60*x)**8)**8",
    "exponentials": "exp(exp(exp(exp(exp(exp(64))))))*x",
    "factors": "*".join(f"(x+{i})" for i in range(250)),
    "roots": "sqrt(" * 60 + "x" + ")" * 60,
    "divisions": "1/(1+" * 40 + "x" + ")" * 40,
    "terms": "+".join("x" for _ in range(900)),
    "signs": "-" * 1900 + "x",
    "parentheses": "(" * 900 + "x" + ")" * 900,
    "digits": "9" * 1990 + "*x",
    "an infinite number": "1e999*x",
    "a division by zero": "(1/0)*x",
    "an infinite difference": "(1e308*10-1e308*10)*x",
    "a complex number": "(-8)**(1/3)*x",
    "merged exponents": "(x**64)**64",
    "hidden exponents": "exp(200*log(x))",
    "a tower": "**".join(["2"] * 40) + "*x",
    "a null byte": "x\0",
    "half a character": "\ud800*x",
    "a warning of Python's": "1if x else x",
    "nothing": "",
}


@pytest.mark.parametrize("text", ENDLESS.values(), ids=ENDLESS)
def test_what_has_no_end_is_refused_at_once(text):
    with pytest.raises(ConfigError):
        _ = Formula(text, ("x",)).expression


@pytest.mark.parametrize("text", [5, None, b"x", ["x"], 1.5])
def test_what_is_no_text_is_refused(text):
    with pytest.raises(ConfigError, match="should be a text"):
        Lifting(("x",), (text,))


def test_numbers_are_those_of_double_precision():
    numbers = {"9**20*x": 9.0**20, "(1/3)**40*x": 3.0**-40, "exp(exp(6))*x": np.exp(np.exp(6))}
    for text, value in numbers.items():
        assert float(Formula(text, ("x",)).evaluate({"x": 1.0})) == pytest.approx(value, rel=1e-14)


def test_multiplying_out_has_an_end():
    with pytest.raises(ConfigError, match="multiplied out"):
        _ = Lifting(("x", "y"), ("(x + y + p + x*y)**64",), ("p",)).separation
    assert len(Lifting(("x",), ("(x + p)**8",), ("p",)).separation.basis) == 9


@pytest.mark.parametrize(
    "make",
    [
        lambda: polynomials(["x", "y", "z"], 10**6),
        lambda: polynomials(["x"], 10**400),
        lambda: check_family(
            {"kind": "radial", "names": ["x"], "length": 1, "centres": {"kind": "kmeans", "n": 10**12, "seed": 0}}
        ),
        lambda: check_family({"kind": "harmonics", "angle": "x", "ratio": 10**400}),
        lambda: check_family({"kind": "polynomials", "names": ["x"], "degree": float("inf")}),
    ],
)
def test_families_without_end_are_refused(make):
    with pytest.raises(ConfigError):
        make()


JUMPS = [
    "atan(tan(x))",
    "atan(sin(x)/cos(x))",
    "atan(1/x)",
    "tanh(1/x)",
    "atan(exp(20*x)/(exp(20*x) - 1))",
    "sign(sin(x))",
    "abs(sign(x) + 0.5)",
    "sin(sign(x)*pi/2)",
    "tanh(1000*tan(x))",
    "atan(1/(1 + cos(2*x)))",
    "exp(-1/x**3)",
    "atan(log(x**2))",
    "(x**3)**(1/3)",
    "atan((x - 0.3)**-1.0)",
    "sqrt(abs(x) - 1)",
    "atan(tan(y + x))",
]


@pytest.mark.parametrize("text", JUMPS)
def test_a_slope_across_a_jump_has_no_bound(text):
    lifting = Lifting(("x", "y"), (text,))
    lower, upper = lifting.slope_bounds({"x": (-2, 2), "y": (-1, 1)})
    assert (lower[0, 0], upper[0, 0]) == (-np.inf, np.inf)
    K = gain(np.array([[0.1], [0], [0]]), 1.0)
    A = np.array([[0.5, 0, 0.1], [0, 0.5, 0], [0, 0, 0]])
    o = Observer("o", lifting, A, np.zeros((3, 0)), (0,), (), K, Injection.STATE, 1.0)
    found = relift_certificate(o, {"x": (-2, 2), "y": (-1, 1)})
    assert (found.certified, found.status) == (False, ReliftStatus.UNBOUNDED)
    assert "not continuous" in found.reason


def test_slopes_between_any_two_points_are_within_the_bounds():
    """Difference quotients over the whole box, across what may be a jump."""
    rng = np.random.default_rng(0)
    away, whole = {"x": (0.5, 1.2), "y": (-1, 1)}, {"x": (-2, 2), "y": (-1, 1)}
    smooth = ["abs(x)", "x/(1 + abs(x))", "atan(tan(x/4))", "1/(2 + cos(x))", "x*abs(y)", "tan(sin(x))"]
    for text in [*JUMPS, *smooth]:
        for box in (away, whole) if text in smooth else (away,):  # over the whole, jumps have no bounds
            lifting = Lifting(("x", "y"), (text,))
            (lower,), (upper,) = lifting.slope_bounds(box)
            x = np.stack([rng.uniform(*box[name], 600) for name in ("x", "y")], axis=-1)
            z = x.copy()
            z[:, 0] = rng.uniform(*box["x"], 600)
            with np.errstate(all="ignore"):
                quotient = (lifting.lift(x)[:, 2] - lifting.lift(z)[:, 2]) / (x - z)[:, 0]
            if np.isfinite([lower[0], upper[0]]).all():
                assert np.all((quotient >= lower[0] - 1e-6) & (quotient <= upper[0] + 1e-6)), text
    assert np.isfinite(Lifting(("x",), ("atan(tan(x/4))",)).slope_bounds({"x": (-2, 2)})).all()
