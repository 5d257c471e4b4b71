r"""Random members of the certified set against its certificate: errors of observers on them beside the bound for the worst.

Members of the set are drawn as stable, causal contractions of the form

.. math:: \Delta(z) = r\,U_1\,B_1(z)\,U_2\,B_2(z)\,U_3

with U random orthonormal matrices, B diagonal Blaschke products (all-pass, of degree 0, 1 or 2 in every entry) and a size r that is 1 for one
member in two and uniform below 1 for the others. They stand where the certificate puts them, in the study's own form, between the weights as used.
The power of the error is linear in the spectrum of what the observer does not know about, so that all members and all observers of one set cost
one matrix product:

.. math:: \|e\|^2 = \frac{1}{\pi}\int_0^\pi \operatorname{tr}\, T^H T\, \Phi\, d\theta + \|T_n\|^2, \qquad \Phi = (X M)(X M)^H

with ``X = Delta (I - N Delta)^-1``. The integral is a sum over a grid that is dense around all poles; the largest member of every observer is
computed again from its state-space model, by a Lyapunov equation. The machines of the population take the place of X M by ``(Gp - G) W_u``, T by
the response from the state.

Symbols
-------
T : from what Delta does to the weighted error;  M, N : as in `synthesis.problem.uncertainty_location`;  Gp, G : a machine's model and the nominal one
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.lti import StateSpace
from ..core.norms import h2_norm
from ..synthesis import Injection, ObserverProblem
from ..synthesis.problem.plants import generalized_plant
from ..synthesis.worst_case.causal import perturbed
from .contractions import Contractions

Array = npt.NDArray[Any]
_POINTS, _LOWEST = 160, 1e-6
_AROUND = np.concatenate([-np.geomspace(20, 0.15, 8), [0.0], np.geomspace(0.15, 20, 8)])  # of a pole's angle, in units of its damping
_ALIKE = 0.1  # relative distance of poles that share their points
Candidate = tuple[StateSpace, Injection]
_TOGETHER = 40  # members whose spectra are in memory


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Errors of observers over random members of one uncertain set, H2 norms with noise included.

    Parameters
    ----------
    norms : ndarray, shape (observer, member)
    largest : ndarray, shape (observer,)
        The largest one, from a Lyapunov equation.
    units : ndarray, shape (observer, unit)
        Of the models of the population.
    noise : ndarray, shape (observer,)
        Norm of what measurement and process noise alone do.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import MonteCarlo
    >>> drawn = MonteCarlo(np.array([[1.0, 1.2, 1.1]]), largest=np.array([1.2]), units=np.empty((1, 0)), noise=np.array([0.4]))
    >>> drawn.norms.max(axis=1).tolist()
    [1.2]
    """

    norms: Array
    largest: Array
    units: Array
    noise: Array


def sample_errors(
    problem: ObserverProblem, candidates: Sequence[Candidate], members: int, units: StateSpace | None = None, seed: int = 0
) -> MonteCarlo:
    """Return the error of observers over random members of a set.

    Parameters
    ----------
    problem : ObserverProblem
        The set, its noise and its input weight.
    candidates : sequence of (StateSpace, Injection)
        Filters of observers, in physical units, and where their corrections enter.
    members : int
    units : StateSpace, optional
        Models in physical units, the unit axis first.
    seed : int

    Returns
    -------
    MonteCarlo

    Raises
    ------
    SynthesisError
        When the set is not well posed.

    Examples
    --------
    >>> from kros.core import StateSpace, gain
    >>> from kros.evaluate import sample_errors
    >>> from kros.synthesis import Injection, ObserverProblem
    >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01)
    >>> problem = ObserverProblem(lag, [[1.0]], gain([[0.1]], 0.01), gain([[1.0]], 0.01), [1.0], [1.0], [0.1])
    >>> drawn = sample_errors(problem, [(gain([[0.2]], 0.01), Injection.STATE)], members=20)
    >>> drawn.norms.shape, drawn.largest.round(2).tolist()
    ((1, 20), [0.12])
    """
    problem.require_sound()
    drawn, rests = draw_members(problem, members, seed)
    loops = [replace(problem, injection=injection).error_system(K) for K, injection in candidates]
    theta, weights = _grid(problem, loops, units)
    freqs, m, n = theta / (2 * np.pi * problem.nominal.dt), problem.nominal.n_inputs, problem.nominal.n_states
    responses = [loop.frequency_response(freqs) for loop in loops]
    noise = np.array([h2_norm(StateSpace(loop.A, loop.B[:, m + n :], loop.C, loop.D[:, m + n :], loop.dt)) ** 2 for loop in loops])
    W_L = problem.W_L.frequency_response(freqs)
    T = [r[..., problem.uncertainty_input] @ W_L for r in responses]
    if problem.remainder_left is not None:
        W_rL = problem.remainder_left.frequency_response(freqs)
        T = [np.concatenate([t, r[..., m : m + n] @ W_rL], axis=-1) for t, r in zip(T, responses, strict=True)]
    power = [
        _power(T, _effects(problem, drawn.some(part), rests.some(part), freqs), weights)
        for part in (slice(i, i + _TOGETHER) for i in range(0, members, _TOGETHER))
    ]
    norms = np.sqrt(np.concatenate(power, axis=1) + noise[:, None])
    return MonteCarlo(
        norms,
        np.array([_exact(problem, c, drawn, rests, int(row.argmax())) for c, row in zip(candidates, norms, strict=True)]),
        np.sqrt(_units_power(problem, responses, units, freqs, weights) + noise[:, None]),
        np.sqrt(noise),
    )


def draw_members(problem: ObserverProblem, members: int, seed: int = 0) -> tuple[Contractions, Contractions]:
    """Return random members of the set: perturbations, and those of the remainder (of no rows where there is none)."""
    rng = np.random.default_rng(seed)
    rows = 0 if problem.remainder_left is None else problem.remainder_left.n_inputs
    columns = 0 if problem.remainder_right is None else problem.remainder_right.n_outputs
    drawn = Contractions.draw(problem.W_L.n_inputs, problem.W_R.n_outputs, members, rng)
    return drawn, Contractions.draw(rows, columns, members, rng)


def _effects(problem: ObserverProblem, drawn: Contractions, rests: Contractions, freqs: Array) -> Array:
    """X M over members and frequencies, below it the remainder's ``Delta_r M_r``, shape (member, f, b, m)."""
    theta = 2 * np.pi * problem.nominal.dt * freqs
    delta, M = drawn.response(theta), problem.M.frequency_response(freqs)
    if problem.N is not None:
        N = problem.N.frequency_response(freqs)
        M = np.linalg.solve(np.eye(N.shape[-2]) - N @ delta, np.broadcast_to(M, (len(delta), *M.shape)))
    effect = delta @ M
    if problem.remainder_right is None:
        return effect
    M_r = (problem.remainder_right @ problem.input_weight).frequency_response(freqs)
    return np.concatenate([effect, rests.response(theta) @ M_r], axis=-2)


def _power(T: Sequence[Array], effects: Array, weights: Array) -> Array:
    """Integral of ``||T effect||_F^2``, shape (observer, member)."""
    seen = np.stack([(weights[:, None, None] * np.conj(np.swapaxes(t, -1, -2)) @ t).ravel() for t in T])
    spectra = (np.conj(effects) @ np.swapaxes(effects, -1, -2)).reshape(len(effects), -1)
    return np.asarray(np.real(seen @ spectra.T))


def _units_power(problem: ObserverProblem, responses: Sequence[Array], units: StateSpace | None, freqs: Array, weights: Array) -> Array:
    if units is None:
        return np.zeros((len(responses), 0))
    m, n, x, u = problem.nominal.n_inputs, problem.nominal.n_states, problem.output_scale, problem.input_scale
    eye, none = np.eye(n), np.zeros((n, m))
    scaled = [StateSpace(A * x / x[:, None], B * u / x[:, None], eye, none, units.dt) for A, B in zip(units.A, units.B, strict=True)]
    nominal = problem.scaled_model.frequency_response(freqs)
    W_u = problem.input_weight.frequency_response(freqs)
    effects = np.stack([(one.frequency_response(freqs) - nominal) @ W_u for one in scaled])
    return _power([r[..., m : m + n] for r in responses], effects, weights)


def _exact(problem: ObserverProblem, candidate: Candidate, drawn: Contractions, rests: Contractions, member: int) -> float:
    K, injection = candidate
    problem, dt = replace(problem, injection=injection), problem.nominal.dt
    closed = generalized_plant(problem).close(problem.to_scaled(K))
    rest = rests.system(member, dt) if problem.remainder_left is not None else None
    return float(h2_norm(perturbed(problem, closed, drawn.system(member, dt), rest)))


def _grid(problem: ObserverProblem, loops: Sequence[StateSpace], units: StateSpace | None) -> tuple[Array, Array]:
    """Angles from 0 to pi, dense around all poles, and the weights of the trapezoidal rule over pi."""
    systems = [*loops, problem.W_L, problem.M, problem.N, problem.remainder_left, problem.remainder_right]
    poles = [s.poles().ravel() for s in systems if s is not None]
    if units is not None:
        poles.append(np.linalg.eigvals(units.A).ravel())
    log = np.log(np.maximum(np.abs(np.concatenate(poles)), 1e-3)) + 1j * np.abs(np.angle(np.concatenate(poles)))
    alike = np.round(np.log(np.maximum([-log.real, log.imag], _LOWEST)) / _ALIKE)
    log = log[np.unique(alike, axis=1, return_index=True)[1]]
    near = (log.imag[:, None] - log.real[:, None] * _AROUND).ravel()
    theta = np.concatenate([[0.0], np.geomspace(_LOWEST, np.pi, _POINTS), near])
    theta = np.unique(np.round(theta[(theta >= 0) & (theta <= np.pi)], 9))
    return theta, np.convolve(np.diff(theta) / np.pi, [0.5, 0.5])
