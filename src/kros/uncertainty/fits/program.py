r"""Small linear programs, one after the other: the dual simplex method on dense rows, from what was active at the end of the program before.

    minimise x_n   s.t.   A x <= 0,   g x = 1

A vertex is where n - 1 rows are active; its multipliers y are positive where no x inside these rows is better. The row that is exceeded most comes in for the
first active one whose multiplier vanishes on the way, so that the value rises from step to step, until no row is exceeded. Of a vertex that another program has
left some multipliers are negative: there the opposite of the row, far away, stands in, with the opposite multiplier. From nothing, bounds far away are active.
A step costs one inverse of n x n: with n of a dozen and some hundred rows a program takes a tenth of what a general solver needs.

References
----------
C. E. Lemke, "The dual method of solving the linear programming problem", Naval Research Logistics Quarterly 1 (1954) 36-47.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

_FAR = 1e8  # rows are of size one, and solutions at most some thousands
_EXCEEDED, _ACROSS = 1e-10, 1e-11
_STEPS = 50  # for every unknown: about ten times what programs take


def solve(A: Array, g: Array, active: Array | None = None) -> tuple[Array, Array] | None:
    """Return x and the n - 1 active rows of: minimise the last of x under `A x <= 0`, `g x = 1`; none where no program was solved."""
    try:
        found = None if active is None else _solve(A, *_near(A, g, active))
        return _solve(A, *_from_nothing(g)) if found is None else found
    except np.linalg.LinAlgError:
        return None if active is None else solve(A, g)


def _from_nothing(g: Array) -> tuple[Array, Array, Array]:
    """Bounds of all unknowns but one, which the last row fixes."""
    n = len(g)
    bounds = np.delete(-np.eye(n), int(np.abs(g[:-1]).argmax()), axis=0)
    return np.vstack([bounds, g]), np.append(np.full(n - 1, _FAR), 1.0), np.full(n - 1, -1)


def _near(A: Array, g: Array, active: Array) -> tuple[Array, Array, Array]:
    """Active rows, the opposite ones far away where multipliers are negative."""
    M, names = np.vstack([A[active], g]), active.copy()
    negative = np.flatnonzero(np.linalg.inv(M)[-1, :-1] > 0)
    M[negative] *= -1
    names[negative] = -1
    return M, np.append(np.where(names < 0, _FAR, 0.0), 1.0), names


def _solve(A: Array, M: Array, right: Array, names: Array) -> tuple[Array, Array] | None:
    """Step from the vertex ``M x = right``, whose rows have positive multipliers; rows that are none of the program's are called -1."""
    for _ in range(_STEPS * len(M)):
        inverse = np.linalg.inv(M)
        x = inverse @ right
        exceeded = A @ x
        worst = int(exceeded.argmax())
        if not exceeded[worst] > _EXCEEDED:
            return None if (names < 0).any() or not np.isfinite(x).all() else (x, names)
        share = (A[worst] @ inverse)[:-1]
        leaving = np.flatnonzero(share > _ACROSS)
        if not leaving.size:
            return None
        first = leaving[(np.maximum(-inverse[-1, leaving], 0.0) / share[leaving]).argmin()]
        M[first], right[first], names[first] = A[worst], 0.0, worst
    return None
