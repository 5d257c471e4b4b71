"""Random, mutated and hostile formulas: what is accepted agrees with arithmetic of sixty digits, what is not is refused with a reason, and soon.

    python benchmarks/reliability/formulas.py [--count 1500] [--seed 0]

The truth is a second evaluator: Python's own expression compiler on mpmath numbers, which knows nothing of SymPy. Values and derivatives may differ
by a billionth, and by a hundred times what inputs and constants that are changed by 1e-13 do to the truth. Bounds of slopes are compared with
quotients of differences between random points of the box.
"""

from __future__ import annotations

import ast
import signal
import time
from collections.abc import Callable
from contextlib import contextmanager, suppress
from typing import Any

import mpmath
import numpy as np
from campaign import LONGEST_S, Tally, main

from kros.core.errors import ConfigError
from kros.lifting import Lifting
from kros.lifting.families import check_family
from kros.lifting.program import Precision, c_code

DIGITS, NAMES = 60, ("x", "y", "p")
BOX = {"x": (-1.5, 2.0), "y": (0.3, 1.1), "p": (-0.4, 0.4)}
FUNCTIONS = ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan", "abs", "sign")
HOSTILE = (
    "((((9**64)**64)**64)**64)*x",
    "exp(exp(exp(exp(exp(exp(64))))))*x",
    "*".join(f"(x+{i})" for i in range(250)),
    "sqrt(" * 60 + "x" + ")" * 60,
    "9" * 1990 + "*x",
    "-" * 1900 + "x",
    "(" * 900 + "x" + ")" * 900,
    "x+" * 900 + "x",
    "x\0",
    "\ud800",
    "((10**60*x)**8)**8",
    "(((99999999/99999998)**64)**64)**64*x",
)
ALPHABET = (
    *"0123456789+-*/().,[] e_xyp\0\n'\"é\ud800λ^%@:=<>!~&|{}#;",
    *FUNCTIONS,
    "**",
    "x",
    "y",
    "p",
    "1e308",
    "64",
    "pi",
    "x[-1]",
)


class HangError(Exception):
    """A case took far too long."""


@contextmanager
def limited(seconds: float):
    """Interrupt what takes longer."""

    def stop(*_: Any) -> None:
        raise HangError

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def random_text(rng: np.random.Generator, depth: int) -> str:
    """Return a formula of the grammar."""
    if depth == 0 or rng.random() < 0.1:
        return str(
            rng.choice(
                [
                    *NAMES[:2],
                    *NAMES[:2],
                    "p",
                    "pi",
                    str(rng.integers(0, 12)),
                    f"{rng.normal():.4g}",
                    f"{10 ** rng.uniform(-6, 6):.3e}",
                ]
            )
        )
    kind = rng.random()
    inner = random_text(rng, depth - 1)
    if kind < 0.35:
        return f"{rng.choice(FUNCTIONS)}({inner})"
    if kind < 0.45:
        return f"({inner})**{rng.choice(['2', '3', '-1', '0.5', '-2', '1.5', '(1/3)', '7', '64'])}"
    if kind < 0.5:
        return f"-({inner})"
    return f"({inner} {rng.choice(list('+-*/'))} {random_text(rng, depth - 1)})"


def mutated(rng: np.random.Generator, text: str) -> str:
    """Return a text with some of it changed, repeated, wrapped or lost."""
    for _ in range(rng.integers(1, 5)):
        at, to = sorted(rng.integers(0, len(text) + 1, 2))
        kind = rng.integers(0, 7)
        piece = text[at:to]
        if kind == 0:
            text = text[:at] + str(rng.choice(ALPHABET)) + text[at:]
        elif kind == 1:
            text = text[:at] + text[at + 1 :]
        elif kind == 2:
            text = text[:at] + piece * int(rng.integers(2, 60)) + text[to:]
        elif kind == 3:
            text = (str(rng.choice(FUNCTIONS)) + "(") * (n := int(rng.integers(1, 80))) + text + ")" * n
        elif kind == 4:
            text = "*".join([f"({text})"] * int(rng.integers(2, 40)))
        elif kind == 5:
            text = f"({text})**{rng.choice(['64', '-64', '9**9', '1e3', '0.1', '(1/7)'])}"
        else:
            text = text.replace(
                str(rng.choice(list("0123456789"))), str(rng.choice(["1e300", "9" * 40, "0", "1e-320", "64**64"]))
            )
    return text[:3000]


def truth_of(text: str) -> Callable[..., Any]:
    """Return the second evaluator: of x, y, p and a function that may change every constant."""

    class Constants(ast.NodeTransformer):
        def visit_Constant(self, node: ast.Constant) -> ast.AST:
            return ast.Call(ast.Name("number", ast.Load()), [node], [])

    tree = ast.fix_missing_locations(Constants().visit(ast.parse(text.strip(), mode="eval")))
    code = compile(tree, "formula", "eval")
    known = {
        name: within(getattr(mpmath, name), 1e4 if name == "exp" else 1e290) for name in FUNCTIONS if name != "abs"
    }
    known |= {"abs": abs, "pi": mpmath.pi, "Abs": abs}

    def evaluate(x: Any, y: Any, p: Any, change: Callable[[Any], Any] = lambda v: v) -> Any:
        found = eval(
            code, {"__builtins__": {}}, known | {"x": x, "y": y, "p": p, "number": lambda v: change(mpmath.mpf(v))}
        )
        return found if isinstance(found, mpmath.mpf) and mpmath.isfinite(found) else None

    return evaluate


def within(function: Callable[[Any], Any], most: float) -> Callable[[Any], Any]:
    """Return a function that gives up where a double would: exponents of exponents have no end in arithmetic of any range."""

    def bounded(argument: Any) -> Any:
        if abs(argument) > most:
            raise OverflowError
        return function(argument)

    return bounded


def point(rng: np.random.Generator) -> list[float]:
    """Return a random place in the box."""
    return [float(rng.uniform(*BOX[name])) for name in NAMES]


def judge(text: str, lifting: Lifting, rng: np.random.Generator) -> str:
    """Compare an accepted formula with the truth; empty where all agrees."""
    with mpmath.workdps(DIGITS):
        evaluate, h = truth_of(text), mpmath.mpf(10) ** -20

        def at(place: list[Any], change: Callable[[Any], Any] = lambda v: v) -> tuple[Any, Any] | None:
            x, y, p = place
            try:
                values = [evaluate(x + step, y, p, change) for step in (0, h, -h)]
            except (ArithmeticError, TypeError, ValueError):
                return None
            return None if any(v is None for v in values) else (values[0], (values[1] - values[2]) / (2 * h))

        for _ in range(3):
            place = point(rng)
            exact = at([mpmath.mpf(v) for v in place])
            noise = lambda v: v * (1 + mpmath.mpf(float(rng.choice([-1e-13, 1e-13]))))  # noqa: E731
            moved = [at([noise(mpmath.mpf(v)) for v in place], noise) for _ in range(3)]
            if exact is None or any(m is None for m in moved):
                continue
            parameters = {"p": place[2]}
            with np.errstate(all="ignore"):
                found = (
                    float(lifting.lift(place[:2], parameters)[2]),
                    float(lifting.slopes(place[:2], parameters)[0, 0]),
                )
            for what, value, wanted, others in zip(
                ("value", "derivative"), found, exact, zip(*moved, strict=True), strict=True
            ):
                spread = max(abs(other - wanted) for other in others)
                allowed = mpmath.mpf("1e-9") * (1 + abs(wanted)) + 100 * spread
                if np.isfinite(value) and abs(wanted) < 1e290 and abs(mpmath.mpf(value) - wanted) > allowed:
                    return f"wrong {what}"
    return ""


def judge_slopes(lifting: Lifting, rng: np.random.Generator) -> str:
    """Compare bounds of the slope by x with quotients of differences; empty where these are within."""
    lower, upper = lifting.slope_bounds({k: BOX[k] for k in ("x", "y", "p")})
    if not np.isfinite([lower[0, 0], upper[0, 0]]).all():
        return ""
    x, z = (rng.uniform(*BOX["x"], 300) for _ in range(2))
    y, p = rng.uniform(*BOX["y"], 300), rng.uniform(*BOX["p"], 300)
    with np.errstate(all="ignore"):
        f, g = (lifting.lift(np.stack([v, y], axis=-1), {"p": p})[:, 2] for v in (x, z))
        quotient = (f - g) / (x - z)
    rounding = 1e-9 * (1 + np.maximum(np.abs(f), np.abs(g))) / np.abs(x - z) + 1e-9 * max(
        abs(lower[0, 0]), abs(upper[0, 0])
    )
    outside = (quotient < lower[0, 0] - rounding) | (quotient > upper[0, 0] + rounding)
    return "false slope bound" if np.any(outside & np.isfinite(quotient)) else ""


def one(text: Any, tally: Tally, rng: np.random.Generator) -> None:
    """Try one formula: read it, use it, and compare."""
    began = time.perf_counter()
    try:
        with limited(LONGEST_S + 5):
            lifting = Lifting(("x", "y"), (text,), ("p",))
            outcome = "accepted, in agreement"
            if not lifting.history:
                [c_code(formula.expression, str, Precision()) for formula in lifting.formulas]
                with suppress(ConfigError):  # a parameter that does not separate
                    _ = lifting.separation
                wrong = judge_slopes(lifting, rng)
                seconds = time.perf_counter() - began
                wrong = wrong or judge(text, lifting, rng)
                tally.add(wrong or outcome, seconds, failed=bool(wrong))
                return
    except ConfigError:
        outcome = "refused with a reason"
    except HangError:
        outcome = "hang"
    except Exception as error:
        tally.add(f"traceback: {type(error).__name__}", time.perf_counter() - began, failed=True)
        return
    tally.add(outcome, time.perf_counter() - began)


def random_table(rng: np.random.Generator) -> dict[str, Any]:
    """Return the table of a family with anything in it."""
    odd: list[Any] = [
        0,
        -1,
        1,
        2,
        3,
        0.5,
        10**6,
        10**12,
        10**400,
        float("nan"),
        float("inf"),
        "x",
        "",
        None,
        True,
        [],
        ["x"],
        ["x", "y"],
        [[0, 1]],
        {},
    ]
    kinds = ["harmonics", "polynomials", "radial", "delays", "other"]
    keys = [
        "names",
        "degree",
        "angle",
        "ratio",
        "orders",
        "phase",
        "length",
        "centres",
        "n",
        "seed",
        "depth",
    ]
    table: dict[str, Any] = {"kind": str(rng.choice(kinds)), "names": ["x", "y"]}
    needed = {
        "harmonics": {"angle": "x"},
        "polynomials": {"degree": 3},
        "radial": {
            "centres": {"kind": "kmeans", "n": 5, "seed": 0},
            "length": 1,
        },
        "delays": {"depth": 2},
    }
    table |= needed.get(table["kind"], {})
    if table["kind"] == "harmonics":
        del table["names"]
    for key in rng.choice([*table, *keys], rng.integers(0, 3)):
        table[str(key)] = odd[int(rng.integers(len(odd)))]
    if isinstance(table.get("centres"), dict) and rng.random() < 0.5:
        table["centres"] = {**table["centres"], str(rng.choice(["n", "seed"])): odd[int(rng.integers(len(odd)))]}
    return table


def run(count: int, seed: int) -> list[Tally]:
    """Run the campaign."""
    rng = np.random.default_rng(seed)
    truth = "mpmath with 60 digits; difference quotients for bounds of slopes"
    grammar, changed, hostile = (
        Tally(cases, truth) for cases in ("random formulas", "mutated formulas", "hostile formulas, mutated")
    )
    for _ in range(count):
        text = random_text(rng, int(rng.integers(1, 6)))
        one(text, grammar, rng)
        one(mutated(rng, text), changed, rng)
    for number in range(max(count // 4, len(HOSTILE))):
        text = HOSTILE[number % len(HOSTILE)]
        one(text if number < len(HOSTILE) else mutated(rng, text), hostile, rng)
    tables = Tally("tables of families", "accepted or refused with a reason")
    for _ in range(count):
        table, began = random_table(rng), time.perf_counter()
        try:
            with limited(LONGEST_S + 5):
                check_family(table)
            tables.add("accepted", time.perf_counter() - began)
        except ConfigError:
            tables.add("refused with a reason", time.perf_counter() - began)
        except Exception as error:
            tables.add(f"traceback: {type(error).__name__}", time.perf_counter() - began, failed=True)
    return [grammar, changed, hostile, tables]


if __name__ == "__main__":
    main("formulas", "Formulas: random, mutated and hostile texts", run, 1500)
