"""Solvers of matrix inequalities and their fallbacks: each within a time limit, nothing accepted that does not survive a check.

The first is the package's own barrier method, then Clarabel, both free of licences; MOSEK follows where it is installed.
A solver that finds the inequalities infeasible is asked again by the next ones, since conic solvers say so of ill-conditioned problems too.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from .barrier import Block, Ending, minimise

Array = npt.NDArray[Any]
T = TypeVar("T")

_MODULES = {"BARRIER": "numpy", "CLARABEL": "clarabel", "MOSEK": "mosek"}
QUICK = ("BARRIER",)


@dataclass(frozen=True, eq=False)
class Program:
    """``min c'x`` subject to matrix inequalities, with a point to start from."""

    c: Array
    blocks: Sequence[Block]
    start: Array


@dataclass(frozen=True, eq=False)
class Answer:
    """What one solver returned: its own word, whether it claims the optimum, the point (None if there is none), the value."""

    solver: str
    word: str
    optimal: bool
    x: Array | None
    value: float


@dataclass(frozen=True, eq=False)
class Attempts(Generic[T]):
    """The first accepted answer, what was made of it, and what the solvers before it said."""

    answer: Answer | None
    accepted: T | None
    notes: list[str] = field(default_factory=list)


def installed() -> list[str]:
    """Return the solvers that can be used here, in the order in which they are tried."""
    return [name for name, module in _MODULES.items() if find_spec(module) is not None]


def solve_with_fallback(
    program: Program,
    check: Callable[[Answer], T | str],
    *,
    time_limit_s: float = 20.0,
    solvers: Sequence[str] | None = None,
    rtol: float = 1e-4,
) -> Attempts[T]:
    """Try solvers in order until an answer passes the check.

    Parameters
    ----------
    program : Program
    check : callable
        Turns an answer into what is wanted, or into the reason why it is rejected.
    time_limit_s : float
        For all solvers together.
    solvers : sequence of str, optional
        Names of solvers; default those that are installed.
    rtol : float
        Accuracy asked of every solver, relative to the value.
    """
    end = time.perf_counter() + time_limit_s
    notes: list[str] = []
    for name in installed() if solvers is None else solvers:
        left = end - time.perf_counter()
        if left <= 0:
            notes.append(f"{name}: not tried, the time limit of {time_limit_s:g} s was used up")
            continue
        answer = solve(program, name, left, rtol)
        verdict: T | str = f"{name}: {answer.word}" if answer.x is None else check(answer)
        if not isinstance(verdict, str):
            return Attempts(answer, verdict, notes)
        notes.append(verdict)
    return Attempts(None, None, notes)


def solve(program: Program, solver: str, time_limit_s: float, rtol: float = 1e-4) -> Answer:
    """Ask one solver."""
    if solver == "BARRIER":
        found = minimise(program.c, program.blocks, program.start, rtol=rtol, time_limit_s=time_limit_s)
        x = found.x if np.isfinite(found.value) else None
        return Answer(solver, found.ending.value, found.ending is Ending.SOLVED, x, found.value)
    if solver == "CLARABEL":
        return _with_cvxpy(program, solver, {"time_limit": time_limit_s, "tol_gap_abs": rtol, "tol_gap_rel": rtol, "tol_feas": 1e-2 * rtol})
    return _with_cvxpy(program, solver, {"mosek_params": {"MSK_DPAR_OPTIMIZER_MAX_TIME": time_limit_s}})


def _with_cvxpy(program: Program, solver: str, settings: dict[str, Any]) -> Answer:
    cp = import_module("cvxpy")  # takes a second, and its own annotations do not describe what it exports
    x = cp.Variable(len(program.c))
    constraints = []
    for block in program.blocks:
        for k in range(block.constant.shape[0]):
            d = block.constant.shape[-1]
            value = cp.reshape(block.basis[:, k].reshape(len(program.c), -1).T @ x, (d, d), order="C") + block.constant[k]
            constraints.append((value + value.T) / 2 >> 0)
    problem = cp.Problem(cp.Minimize(program.c @ x), constraints)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")  # the status says so, and a check follows
            problem.solve(solver=solver, **settings)
    except (cp.error.SolverError, ValueError, ArithmeticError) as error:
        return Answer(solver, str(error).split(". Try another solver")[0], False, None, np.inf)
    if x.value is None or problem.value is None or not np.isfinite(problem.value):
        return Answer(solver, str(problem.status), False, None, np.inf)
    return Answer(solver, str(problem.status), problem.status == "optimal", np.asarray(x.value), float(problem.value))
