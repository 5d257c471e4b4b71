"""One way to ask the solver, and to hear what it says; what it claims is proven elsewhere."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

import numpy as np


def cvxpy() -> Any:
    """Import cvxpy when it is needed: it takes a second. Its own annotations do not describe what it exports."""
    return import_module("cvxpy")


def solve(problem: Any, value: Any, time_limit_s: float) -> tuple[float | None, str]:
    """Solve a program; return the value of one variable, None where there is no solution, and the solver's word."""
    error = cvxpy().error.SolverError
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            problem.solve(solver="CLARABEL", time_limit=time_limit_s)
    except (error, ValueError, ArithmeticError) as failure:
        return None, f"Clarabel: {failure}"
    word = f"Clarabel: {problem.status}"
    if value.value is None or not np.isfinite(value.value) or problem.status not in ("optimal", "optimal_inaccurate"):
        return None, word
    return float(value.value), word
