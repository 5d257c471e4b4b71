r"""The worst case as a disturbance: its spectrum, and rational filters that shape white noise like it.

The disturbance is ``W_L w2`` and acts at the input or at the state. Where W_L is diagonal one filter a channel stands
for W_L and the spectrum of w2 together, which takes fewer states; a full W_L stays as it is behind one filter for every
component of w2.

Symbols
-------
phi : power of every shaped channel, shape (f, channels);  psi : the same for the remainder, shape (f, n)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, block_diagonal, gain
from ...core.rounding import ROUNDING
from ..problem.observer_problem import ObserverProblem
from .ball import Ball, below, uncertain_ball

Array = npt.NDArray[Any]
Fit = Callable[..., Any]

_FLOOR, _NOTHING = 1e-14, 1e-30  # relative power below which a channel is level; power of a channel that is absent


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Power of the shaped channels, and the perturbations (f, b, a) behind it; without them the average of the set."""

    phi: Array
    psi: Array | None
    theta: Array | None = None
    correlated: bool = False

    def power(self, ball: Ball, index: Array) -> Array:
        """Power of w2 at other frequencies, (k, b): contractions of given points of the design grid in another ball."""
        if self.theta is not None:
            return ball.spectrum(self.theta[index])
        return below(ball.average()) if self.correlated else _diagonal(ball.average())


@dataclass(frozen=True, eq=False)
class Shaping:
    """Rational factors of a spectrum, one a channel, and the system behind them (W_L, or None where contained)."""

    filters: StateSpace
    behind: StateSpace | None
    remainder: StateSpace | None

    def at_input_and_state(self, problem: ObserverProblem) -> tuple[StateSpace, StateSpace]:
        """Return the shaped disturbances at the input, m outputs, and at the state, n outputs."""
        m, n, dt = problem.nominal.n_inputs, problem.nominal.n_states, problem.nominal.dt
        shaped = self.filters if self.behind is None else self.behind @ self.filters
        at_state = [] if problem.location.at_input else [shaped]
        at_state += [] if self.remainder is None else [self.remainder]
        at_input = shaped if problem.location.at_input else gain(np.zeros((m, 0)), dt)
        if not at_state:
            return at_input, gain(np.zeros((n, 0)), dt)
        return at_input, gain(np.hstack([np.eye(n)] * len(at_state)), dt) @ block_diagonal(at_state)


def is_diagonal(system: StateSpace) -> bool:
    """Tell whether the system is square and its off-diagonal transfer functions vanish (Markov parameters)."""
    if system.n_outputs != system.n_inputs:
        return False
    off = ~np.eye(system.n_outputs, dtype=bool)
    block, size = system.B, float(np.abs(system.C).max(initial=0) * np.abs(system.B).max(initial=0))
    if np.any(system.D[off]):
        return False
    for _ in range(2 * system.n_states):
        if np.any(np.abs((system.C @ block)[off]) > ROUNDING * size):
            return False
        block = system.A @ block
    return True


def symmetric(problem: ObserverProblem) -> bool:
    """Tell whether the diagonal of any element's spectrum is an average over the set."""
    location = problem.location
    if problem.N is None:
        return True
    weights = problem.W_L, problem.W_R, problem.input_weight
    return location.sees_input and location.at_input and all(is_diagonal(weight) for weight in weights)


def design_grid(problem: ObserverProblem, count: int = 400) -> Array:
    """Frequencies for the design, Hz: logarithmic from well below the slowest pole to Nyquist."""
    dt = problem.nominal.dt
    systems = [problem.nominal, problem.W_L, problem.W_R, problem.input_weight]
    slowest = np.abs(np.concatenate([s.poles() for s in systems]) - 1).min(initial=1.0)
    return np.geomspace(min(max(slowest / 30, 1e-7), 1e-2), np.pi, count) / (2 * np.pi * dt)


class Channels:
    """The channels that are shaped, on a grid of frequencies; `apart` leaves a diagonal W_L behind the filters too."""

    def __init__(self, problem: ObserverProblem, freqs_hz: Array, apart: bool = False) -> None:
        self.problem, self.freqs_hz = problem, freqs_hz
        self.ball = uncertain_ball(problem, freqs_hz)
        self.left = problem.W_L.frequency_response(freqs_hz)
        self.contained = not apart and is_diagonal(problem.W_L)

    def average(self, correlated: bool = False) -> Spectrum:
        """Average over the set, or the largest diagonal spectrum below it where its channels are correlated."""
        power = below(self.ball.average()) if correlated else _diagonal(self.ball.average())
        return Spectrum(self._shaped(power), self._remainder(), correlated=correlated)

    def worst(self, controller: StateSpace) -> Spectrum:
        """Spectrum of the element of the set that is (locally) worst for a given observer."""
        loop = self.problem.error_system(controller).frequency_response(self.freqs_hz)
        theta = self.ball.worst(loop[..., self.problem.uncertainty_input] @ self.left)
        return Spectrum(self._shaped(self.ball.spectrum(theta)), self._remainder(), theta)

    def nearest(self, theta: Array) -> Array:
        """Return the nearest points of the grid to angles."""
        grid = 2 * np.pi * self.problem.nominal.dt * self.freqs_hz
        return np.searchsorted((grid[1:] + grid[:-1]) / 2, theta)

    def _shaped(self, power: Array) -> Array:
        """Power of the channels for the power of w2."""
        return np.sum(np.abs(self.left) ** 2, axis=-1) * power if self.contained else power

    def _remainder(self) -> Array | None:
        """Average spectrum of the remainder, shape (f, n)."""
        problem = self.problem
        if problem.remainder_left is None or problem.remainder_right is None:
            return None
        left = problem.remainder_left.frequency_response(self.freqs_hz)
        right = (problem.remainder_right @ problem.input_weight).frequency_response(self.freqs_hz)
        energy = np.sum(np.abs(right) ** 2, axis=(-2, -1)) / max(left.shape[-1], right.shape[-2])
        return np.sum(np.abs(left) ** 2, axis=-1) * energy[:, None]

    def shaping(self, spectrum: Spectrum, fit: Fit, side: str) -> Shaping:
        """Fit one rational factor a channel, which touches its spectrum from above or from below."""
        remainder = None if spectrum.psi is None else self._factor(spectrum.psi, fit, side)
        behind = None if self.contained else self.problem.W_L
        return Shaping(self._factor(spectrum.phi, fit, side), behind, remainder)

    def _factor(self, power: Array, fit: Fit, side: str) -> StateSpace:
        systems, dt = [], self.problem.nominal.dt
        for column in power.T:
            if column.max() <= _NOTHING:
                systems.append(gain([[0.0]], dt))
                continue
            magnitude = np.sqrt(np.maximum(column, _FLOOR * column.max()))
            system = fit(self.freqs_hz, magnitude / magnitude.max(), dt).system
            ratio = magnitude / np.abs(system.frequency_response(self.freqs_hz)[:, 0, 0])
            scale = gain([[float(ratio.max() if side == "above" else ratio.min())]], dt)
            systems.append(scale @ system)
        return block_diagonal(systems)


def _diagonal(spectrum: Array) -> Array:
    return np.real(np.einsum("fii->fi", spectrum))
