r"""Local improvement of a mixed controller of fixed order: ``min ||T11||_2`` subject to ``||T22||_inf < gamma``.

Sequential quadratic programming on the controller's matrices. The norm of T11 has an analytic gradient (two Gramians); the constraint is set at
frequencies, where ``sigma_max(T22)`` has the gradient ``Re(u* C_cl(z) dTheta B_cl(z) v)``. The norm between the frequencies is then computed by
level sets; where it exceeds gamma the peak joins the frequencies and the level is lowered.

Symbols
-------
Theta = [[D^c, C^c], [B^c, A^c]] : the controller;  u, v : singular vectors of T22 at its largest singular value
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..reduction.affine_loop import AffineLoop
from .channels import part

Array = npt.NDArray[Any]

_GRID, _ROUNDS, _ITERATIONS = 60, 8, 60
_BACK_OFF = 1e-4
_UNSTABLE = 1e3


@dataclass(frozen=True, eq=False)
class _Problem:
    """The loop, the units of its entries, and the clock."""

    loop: AffineLoop
    units: Array
    gamma: float
    end: float

    def theta(self, x: Array) -> Array:
        return x.reshape(self.units.shape) * self.units

    def cost(self, x: Array) -> tuple[float, Array]:
        """Logarithm of the squared H2 norm and its gradient."""
        if time.perf_counter() > self.end:
            raise TimeoutError
        p = self.loop.plant
        value, gradient = self.loop.h2_squared(self.theta(x), p.rows(1), p.columns(1))
        if not 0 < value < np.inf:
            return _UNSTABLE, np.zeros_like(x)
        return float(np.log(value)), (gradient * self.units).ravel() / value

    def gains(self, x: Array, freqs_hz: Array) -> tuple[Array, Array]:
        """Logarithm of ``sigma_max(T22) / gamma`` at the frequencies, and its derivatives, shape (f, x)."""
        p, loop = self.loop.plant, self.loop.close(self.theta(x))
        rows, columns = p.rows(2), p.columns(2)
        (B_u, D_u), (C_y, D_y) = self.loop.into, self.loop.out_of
        n = loop.n_states
        z = np.exp(2j * np.pi * freqs_hz * loop.dt)
        resolvent = np.linalg.inv(z[:, None, None] * np.eye(n) - loop.A)
        B, C = loop.B[:, columns], loop.C[rows]
        U, s, Vh = np.linalg.svd(C @ resolvent @ B + loop.D[rows, columns], full_matrices=False)
        left = np.einsum("fi,fij->fj", U[:, :, 0].conj(), C @ resolvent @ B_u + D_u[rows])
        right = np.einsum("fij,fj->fi", C_y @ resolvent @ B + D_y[:, columns], Vh[:, 0].conj())
        slope = np.real(left[:, :, None] * right[:, None, :]) * self.units
        size = np.maximum(s[:, 0], 1e-300)
        return np.log(size / self.gamma), slope.reshape(len(z), -1) / size[:, None]


def improved(plant: GeneralizedPlant, controller: StateSpace, gamma: float, time_limit_s: float) -> StateSpace:
    """Return a controller of the same order that is at least as good, for one that stabilises with ``||T22||_inf < gamma``."""
    loop = AffineLoop(plant, controller.n_states)
    start = loop.theta(controller)
    units = loop.typical(start)
    problem = _Problem(loop, units, gamma, time.perf_counter() + time_limit_s)
    x, best, best_norm = (start / units).ravel(), controller, _norms(plant, controller)[0]
    freqs_hz, level = _frequencies(loop.close(start)), 1 - _BACK_OFF
    for _ in range(_ROUNDS):
        try:
            x_new = _programme(problem, x, freqs_hz, level)
        except (TimeoutError, np.linalg.LinAlgError, ValueError):
            break
        candidate = loop.controller(problem.theta(x_new))
        norm, peak = _norms(plant, candidate)
        if not np.isfinite(peak):
            break
        if peak < gamma:
            if norm < best_norm:
                gained = 1 - norm / best_norm
                best, best_norm, x = candidate, norm, x_new
                if gained < 1e-4:
                    break
                continue
            break
        dense = _frequencies(loop.close(problem.theta(x_new)), 600)
        excess, _ = problem.gains(x_new, dense)
        peaks = np.flatnonzero(
            (excess >= np.maximum(np.roll(excess, 1), np.roll(excess, -1))) & (excess > np.log(level) - 0.05)
        )
        freqs_hz = np.union1d(freqs_hz, dense[peaks])
        level = min(level, level * gamma / peak * (1 - _BACK_OFF)) if peak < 1.05 * gamma else level
        x = x_new if peak < 1.5 * gamma else x
    return best


def _programme(problem: _Problem, x: Array, freqs_hz: Array, level: float) -> Array:
    """Run sequential quadratic programming with the constraint at some frequencies."""
    from scipy.optimize import minimize

    remembered: dict[bytes, tuple[Array, Array]] = {}

    def gains(point: Array) -> tuple[Array, Array]:
        key = point.tobytes()
        if key not in remembered:
            remembered.clear()
            remembered[key] = problem.gains(point, freqs_hz)
        return remembered[key]

    room: dict[str, Any] = {"type": "ineq", "fun": lambda v: np.log(level) - gains(v)[0], "jac": lambda v: -gains(v)[1]}
    cost: Callable[[Array], tuple[float, Array]] = problem.cost
    p = problem.loop.plant
    rooms = [room] if p.D11[p.rows(2), p.columns(2)].size else []
    found = minimize(
        cost, x, jac=True, method="SLSQP", constraints=rooms, options={"maxiter": _ITERATIONS, "ftol": 1e-7}
    )
    return np.asarray(found.x)


def _norms(plant: GeneralizedPlant, controller: StateSpace) -> tuple[float, float]:
    """Norms of T11 and T22."""
    closed = plant.close(controller)
    return h2_norm(part(plant, closed, 1)), hinf_norm(part(plant, closed, 2))


def _frequencies(closed: StateSpace, count: int = _GRID) -> Array:
    """Frequencies in Hz: of the poles, and logarithmically between far below the slowest and the highest."""
    poles = closed.poles().astype(complex)
    poles = np.log(poles[np.abs(poles) > 1e-9]) / closed.dt
    sizes = np.abs(poles)[np.abs(poles) > 0] / (2 * np.pi)
    top = 0.5 / closed.dt
    bottom = min(sizes.min(initial=top) / 10, top / 100)
    resonances = np.abs(poles.imag) / (2 * np.pi)
    grid = np.geomspace(bottom, top, count)
    return np.unique(
        np.concatenate([[0.0], grid, np.linspace(0, top, count // 2), resonances[resonances < top], sizes[sizes < top]])
    )
