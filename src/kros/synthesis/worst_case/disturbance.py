r"""The worst case as a disturbance: its spectrum, and rational filters that shape white noise like it.

The disturbance is ``W_L w2`` and acts at the input or at the state. Where W_L is diagonal one filter a channel stands for W_L and the spectrum
of w2 together, which takes fewer states; a full W_L stays as it is behind one filter for every component of w2.

Symbols
-------
phi : power of every shaped channel, shape (f, channels);  psi : the same for the remainder, shape (f, n)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, block_diagonal, gain
from ..problem.observer_problem import ObserverProblem
from .ball import Ball, below

Array = npt.NDArray[Any]
Fit = Callable[..., Any]

_GRID = 400
_FLOOR, _NOTHING = 1e-14, 1e-30
_ALIKE = 9  # decimals, in nepers, to which spectra of one shape agree


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Power of the shaped channels on the design grid: phi (f, channels) and psi (f, n) or None."""

    phi: Array
    psi: Array | None
    thetas: tuple[tuple[float, Array], ...] = ()
    sharp: bool = True  # the diagonal of an element's spectrum is an average over the set

    def mixed_with(self, phi: Array, theta: Array, weight: float) -> Spectrum:
        """Return the average of this spectrum and of that of an element."""
        shares = tuple((share * (1 - weight), other) for share, other in self.thetas)
        return replace(self, phi=(1 - weight) * self.phi + weight * phi, thetas=(*shares, (weight, theta)))

    def calmed(self) -> Spectrum:
        """Return the average of this spectrum and of the average over the ball, which lets no channel of any frequency go; phi is left to `mixture`."""
        return replace(self, thetas=tuple((share / 2, theta) for share, theta in self.thetas))

    def power(self, ball: Ball, index: Array) -> Array:
        """Power of w2 at other frequencies, shape (k, b): the same contractions, those of the given points of the design grid, in another ball."""
        if not self.sharp:
            return below(ball.average())
        power = (1 - sum(share for share, _ in self.thetas)) * np.real(np.einsum("fii->fi", ball.average()))
        for share, theta in self.thetas:
            power = power + share * ball.spectrum(theta[index])
        return np.asarray(power)


@dataclass(frozen=True, eq=False)
class Shaping:
    """Rational factors of a spectrum, one a channel, and the system that they drive (W_L, or None where it is contained)."""

    filters: StateSpace
    behind: StateSpace | None
    remainder: StateSpace | None

    def at_input_and_state(self, problem: ObserverProblem) -> tuple[StateSpace, StateSpace]:
        """Return the shaped disturbances at the input, m outputs, and at the state, n outputs."""
        m, n, dt = problem.nominal.n_inputs, problem.nominal.n_states, problem.nominal.dt
        shaped = self.filters if self.behind is None else self.behind @ self.filters
        at_input = shaped if problem.location.at_input else gain(np.zeros((m, 0)), dt)
        at_state = [s for s in (None if problem.location.at_input else shaped, self.remainder) if s is not None]
        return at_input, _sum(at_state) if at_state else gain(np.zeros((n, 0)), dt)


def default_fit() -> Fit:
    """Return `kros.uncertainty.fit_magnitude`."""
    from ...uncertainty.weights.magnitude import fit_magnitude

    return fit_magnitude


def _sum(systems: list[StateSpace]) -> StateSpace:
    """Add the outputs of systems with inputs of their own."""
    stacked = block_diagonal(systems)
    add = np.hstack([np.eye(systems[0].n_outputs)] * len(systems))
    return StateSpace(stacked.A, stacked.B, add @ stacked.C, add @ stacked.D, stacked.dt)


def uncertain_ball(problem: ObserverProblem, freqs_hz: Array) -> Ball:
    """Return the ball of ``Delta (I - N Delta)^-1 M``."""
    M = problem.M.frequency_response(freqs_hz)
    if problem.N is None:
        return Ball.without_loop(M, problem.W_L.n_inputs)
    return Ball.of(problem.N.frequency_response(freqs_hz), M)


def is_diagonal(system: StateSpace) -> bool:
    """Tell whether the system is square and its off-diagonal transfer functions vanish (Markov parameters up to twice the order)."""
    if system.n_outputs != system.n_inputs:
        return False
    off = ~np.eye(system.n_outputs, dtype=bool)
    block, size = system.B, float(np.abs(system.C).max(initial=0) * np.abs(system.B).max(initial=0))
    if np.any(system.D[off]):
        return False
    for _ in range(2 * system.n_states):
        if np.any(np.abs((system.C @ block)[off]) > 1e-12 * size):
            return False
        block = system.A @ block
    return True


def symmetric(problem: ObserverProblem) -> bool:
    """Tell whether the set keeps every change of signs, so that the diagonal of any element's spectrum is an average over the set."""
    if problem.N is None:
        return True
    location = problem.location
    return (
        location.sees_input
        and location.at_input
        and all(is_diagonal(s) for s in (problem.W_L, problem.W_R, problem.input_weight))
    )


def design_grid(problem: ObserverProblem) -> Array:
    """Frequencies for the design, Hz: logarithmic from well below the slowest pole to Nyquist."""
    dt = problem.nominal.dt
    systems = [problem.nominal, problem.W_L, problem.W_R, problem.input_weight]
    poles = np.concatenate([s.poles() for s in systems])
    slowest = np.abs(poles - 1).min(initial=1.0)
    return np.geomspace(min(max(slowest / 30, 1e-7), 1e-2), np.pi, _GRID) / (2 * np.pi * dt)


class Channels:
    """The channels that are shaped, on a grid of frequencies."""

    def __init__(self, problem: ObserverProblem, freqs_hz: Array, apart: bool = False) -> None:
        self.problem, self.freqs_hz = problem, freqs_hz
        self.ball = uncertain_ball(problem, freqs_hz)
        self.left = problem.W_L.frequency_response(freqs_hz)
        self.contained = not apart and is_diagonal(problem.W_L)
        self.behind = None if self.contained else problem.W_L
        self._fits: dict[Any, StateSpace] = {}

    def shaped(self, power: Array) -> Array:
        """Power of the channels for the power of w2."""
        return np.sum(np.abs(self.left) ** 2, axis=-1) * power if self.contained else power

    def mixture(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum of the same contractions for the channels as they are shaped here."""
        return replace(spectrum, phi=self.shaped(spectrum.power(self.ball, np.arange(len(self.freqs_hz)))))

    def average(self) -> Spectrum:
        """Average over the set; every causal observer costs at least its share of it."""
        return Spectrum(self.shaped(np.real(np.einsum("fii->fi", self.ball.average()))), self._remainder())

    def below_average(self) -> Spectrum:
        """Largest diagonal spectrum below the average, where its channels are correlated."""
        return Spectrum(self.shaped(below(self.ball.average())), self._remainder(), sharp=False)

    def worst(self, controller: StateSpace) -> tuple[Array, Array]:
        """Spectrum of the element of the set that is (locally) worst for a given observer, and its contraction."""
        T = (
            self.problem.error_system(controller).frequency_response(self.freqs_hz)[..., self.problem.uncertainty_input]
            @ self.left
        )
        theta = self.ball.worst(T)
        return self.shaped(self.ball.spectrum(theta)), theta

    def ball_of(self, N: Array | None, M: Array) -> Ball:
        """Return the ball for N and M at other frequencies."""
        return Ball.without_loop(M, self.problem.W_L.n_inputs) if N is None else Ball.of(N, M)

    def nearest(self, theta: Array) -> Array:
        """Return the nearest points of the grid to angles."""
        grid = 2 * np.pi * self.problem.nominal.dt * self.freqs_hz
        return np.searchsorted((grid[1:] + grid[:-1]) / 2, theta)

    def _remainder(self) -> Array | None:
        """Average spectrum of the remainder, shape (f, n)."""
        problem = self.problem
        if problem.remainder_left is None or problem.remainder_right is None:
            return None
        left = problem.remainder_left.frequency_response(self.freqs_hz)
        right = (problem.remainder_right @ problem.input_weight).frequency_response(self.freqs_hz)
        energy = np.sum(np.abs(right) ** 2, axis=(-2, -1)) / max(left.shape[-1], right.shape[-2])
        return np.sum(np.abs(left) ** 2, axis=-1) * energy[:, None]

    def shaping(
        self, spectrum: Spectrum, fit: Fit, side: str, options: dict[str, Any], remainder: StateSpace | None = None
    ) -> Shaping:
        """Fit one rational factor a channel; those of the remainder unless they are given."""

        def factor(power: Array) -> StateSpace:
            systems = []
            for column in power.T:
                if column.max() <= _NOTHING:
                    systems.append(gain([[0.0]], self.problem.nominal.dt))
                    continue
                magnitude = np.sqrt(np.maximum(column, _FLOOR * column.max()))
                systems.append(_touching(self._fitted(magnitude, fit, options), self.freqs_hz, magnitude, side))
            return block_diagonal(systems)

        if remainder is None and spectrum.psi is not None:
            remainder = factor(spectrum.psi)
        return Shaping(factor(spectrum.phi), self.behind, remainder)

    def _fitted(self, magnitude: Array, fit: Fit, options: dict[str, Any]) -> StateSpace:
        """Fit of a magnitude, whatever its size, once."""
        shape = np.round(np.log(magnitude / magnitude.max()), _ALIKE)
        key = shape.tobytes(), fit, tuple(sorted(options.items()))
        if key not in self._fits:
            self._fits[key] = fit(self.freqs_hz, np.exp(shape), self.problem.nominal.dt, **options).system
        return self._fits[key]


def _touching(system: StateSpace, freqs_hz: Array, magnitude: Array, side: str) -> StateSpace:
    """Scale a fit until it touches the magnitude from above or from below."""
    ratio = magnitude / np.abs(system.frequency_response(freqs_hz)[:, 0, 0])
    scale = float(ratio.max() if side == "above" else ratio.min())
    return StateSpace(system.A, system.B, system.C * scale, system.D * scale, system.dt)
