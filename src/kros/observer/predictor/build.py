"""Observers made of models of the past: hidden states as coordinates, measured rows fitted to single steps, and the whole way from recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import null_space

from ...core.linalg import least_squares
from ...core.lti import gain
from ...lifting import Lifting
from ...synthesis.residual_shaped.shaping import Bank
from ...synthesis.result import Injection
from ..observer import Observer
from .blocks import Array, Model
from .moments import DELAYS, SHORT, SKIP, THIN, Past, hidden_of, seen_by
from .tuning import tune_memory

DEVIATION = 0.4


def observer_with_memory(
    name: str,
    lifting: Lifting,
    measured: Sequence[int],
    inputs: Sequence[str],
    states: Array,
    recorded: Array,
    lengths: npt.ArrayLike,
    units: Sequence[str],
    sample_period_s: float,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    memories: int = 12,
    importance: npt.ArrayLike = 1.0,
    deviation: float = DEVIATION,
    longest_s: float | None = None,
    samples: int = 6000,
    episodes: int = 2,
    iterations: int = 25,
) -> Observer:
    """Return the observer with a memory that recordings of some units give: identified, reduced and tuned.

    Parameters
    ----------
    name : str
    lifting : Lifting
        Its functions read measured states alone; no delays, no functions of inputs.
    measured : sequence of int
    inputs : sequence of str
    states : ndarray, shape (n_samples, batch, n)
    recorded : ndarray, shape (n_samples, batch, m)
        The inputs.
    lengths : array_like of int, shape (batch,)
    units : sequence of str, length batch
    sample_period_s : float
    parameters : mapping of str to array_like, shape (batch,)
    memories : int
        States besides the recorded ones.
    importance : array_like, shape (h,)
        Weights of the hidden states' logarithmic errors.
    deviation : float
        Share by which the lifted functions' effect may differ from machine to machine.
    longest_s : float, s, optional
        Time constant of the longest memory; by default a twenty-fifth of the shortest episode. Controllers integrate, and a long memory does so
        too: of a command it knows more, until the command meets a limit that the memory does not know.
    samples, episodes : int
        The first so many samples of the first so many episodes of every unit are tuned on.
    iterations : int
        Most steps of tuning; none leaves the observer as reduced.

    Raises
    ------
    DimensionError
        When the lifting reads hidden or earlier values, or has functions of inputs.
    DataError
        When every state is measured, or an episode is too short.
    """
    counts = np.asarray(lengths, dtype=int)
    slowest = 1 - (SHORT / int(counts.min()) if longest_s is None else sample_period_s / longest_s)
    past = Past.of(lifting, measured, states, recorded, counts, units, parameters, Bank(DELAYS, (slowest,)))
    model = past.model(len(hidden_of(lifting, measured)) + memories, importance=importance, deviation=deviation)
    few = [i for i in range(len(units)) if list(units[:i]).count(units[i]) < episodes]
    cut = min(samples, int(counts[few].min()))
    x, u, own = states[:cut, few], recorded[:cut, few], [units[i] for i in few]
    values = {key: np.asarray(value, dtype=float)[few] for key, value in (parameters or {}).items()}
    model, _ = tune_memory(model, past, x, u, own, values, importance, deviation, slowest, iterations)
    return embedded(name, past, model, inputs, x, u, sample_period_s, values)


def remembering_observer(
    name: str,
    past: Past,
    memories: int,
    inputs: Sequence[str],
    states: Array,
    recorded: Array,
    sample_period_s: float,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    without: Sequence[str] = (),
    importance: npt.ArrayLike = 1.0,
    deviation: float = 0.0,
) -> Observer:
    """Return an observer with states of its own, for all units but some.

    Parameters
    ----------
    name : str
    past : Past
    memories : int
        States besides the original ones: they take the place of a correction filter's.
    inputs : sequence of str
    states : ndarray, shape (n_samples, batch, n)
        Recordings to fit the measured states' rows on, of the units that take part.
    recorded : ndarray, shape (n_samples, batch, m)
        Their inputs.
    sample_period_s : float
    parameters : mapping of str to array_like, shape (batch,)
    without : sequence of str
    importance : array_like, shape (h,)
        Weights of the hidden states' mean square errors, each relative to what the whole bank leaves of it.
    deviation : float
        Share by which the lifted functions' effect may differ from machine to machine.

    Returns
    -------
    Observer
        Its lifting has ``memory_1, ...`` after the original states; its correction is a gain.
    """
    model = past.model(len(hidden_of(past.lifting, past.measured)) + memories, without, importance, deviation)
    return embedded(name, past, model, inputs, states, recorded, sample_period_s, parameters)


def embedded(
    name: str,
    past: Past,
    model: Model,
    inputs: Sequence[str],
    states: Array,
    recorded: Array,
    sample_period_s: float,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
) -> Observer:
    """Write a model F, G, H into an observer; arguments as in `remembering_observer`."""
    lifting, measured = past.lifting, past.measured
    n, q, m, hidden = lifting.n_states, len(measured), recorded.shape[-1], hidden_of(lifting, measured)
    F, G, H = model
    memories = len(F) - len(hidden)
    turn = np.vstack([H, null_space(H / np.linalg.norm(H, axis=1)[:, None]).T])
    back = np.linalg.inv(turn)
    F, G = turn @ F @ back, turn @ G
    z = seen_by(lifting, measured, past.static, past.free, states[..., list(measured)], recorded, parameters)
    following = _measured_rows(F, G, z, states[..., list(measured)])
    place = [*hidden, *range(n, n + memories)]
    raw = np.zeros((n + memories, q + m + len(lifting.functions)))  # of y, u and sigma, in place of z
    own = np.zeros((n + memories, n + memories))
    channels = [*range(q), *(q + j for j in past.free), *range(q + m, raw.shape[1])]
    raw[np.ix_(place, channels)], own[np.ix_(place, place)] = G, F
    raw[np.ix_(list(measured), channels)], own[np.ix_(list(measured), place)] = following[:, len(F) :], following[:, : len(F)]
    raw[:, q : q + m] -= raw[:, :q] @ past.static
    raw[list(measured), range(q)] += 1.0
    own[:, list(measured)] = raw[:, :q]
    widened = replace(lifting, states=(*lifting.states, *(f"memory_{i + 1}" for i in range(memories))))
    silent = np.zeros((len(lifting.functions), widened.n_lifted))
    A = np.vstack([np.hstack([own, raw[:, q + m :]]), silent])
    B, D = (np.vstack([M, silent[:, : M.shape[1]]]) for M in (raw[:, q : q + m], raw[:, :q]))
    return Observer(
        name,
        widened,
        A,
        B,
        measured,
        tuple(inputs),
        gain(D, sample_period_s),
        Injection.STATE,
        sample_period_s,
        replaces=True,
        internal=memories,
    )


def _measured_rows(F: Array, G: Array, z: Array, y: Array) -> Array:
    """Fit the change of the measured states on h and z, shape (q, order + channels)."""
    h = np.zeros((*z.shape[:2], len(F)))
    driven = z @ G.T
    for k in range(len(z) - 1):
        h[k + 1] = h[k] @ F.T + driven[k]
    regressors = np.concatenate([h, z], axis=-1)[SKIP:-1:THIN].reshape(-1, len(F) + z.shape[-1])
    change = np.diff(y, axis=0)[SKIP::THIN].reshape(-1, y.shape[-1])
    return least_squares(regressors, change).T
