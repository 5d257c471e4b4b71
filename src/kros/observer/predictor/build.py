"""Predictors as observers: hidden states as coordinates, measured rows fitted to single steps, and the whole way from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...core.lti import gain
from ...data import EpisodeBatch
from ...lifting import Lifting
from ...loops import recursion
from ...synthesis.residual_shaped.shaping_filter import Basis
from ...synthesis.result import Injection
from ..observer import Observer
from ..tuning.blocks import Array, Model
from .free_start import FreeStart, in_motion
from .moments import DELAYS, SHORT, THIN, PastMoments, hidden_of, skipped
from .tuning import tune_predictor

DEVIATION = 0.4
RIDGE = 1e-6  # errors without measurements are up to five times smaller than with none


def identify_predictor(
    name: str,
    lifting: Lifting,
    measured: Sequence[int],
    inputs: Sequence[str],
    batch: EpisodeBatch,
    internal: int = 12,
    importance: npt.ArrayLike = 1.0,
    deviation: float = DEVIATION,
    longest_s: float | None = None,
    samples: int = 6000,
    episodes: int = 2,
    iterations: int = 25,
) -> Observer:
    """Return the observer that recordings of some units give as their subspace-identified predictor: identified, reduced and tuned.

    Parameters
    ----------
    name : str
    lifting : Lifting
        Its functions read measured states alone; no delays, no functions of inputs.
    measured : sequence of int
    inputs : sequence of str
    batch : EpisodeBatch
    internal : int
        States besides the recorded ones.
    importance : array_like, shape (h,)
        Weights of the hidden states' logarithmic errors.
    deviation : float
        Share by which the lifted functions' effect may differ from machine to machine.
    longest_s : float, s, optional
        Time constant of the slowest internal state; by default a twenty-fifth of the shortest episode. Controllers integrate, and a slow predictor does
        so too, which is more accurate until the command meets a limit that is not in the model.
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

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.lifting import Lifting
    >>> from kros.observer import identify_predictor
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=1, seconds=2.0, seed=3).simulate().population
    >>> batch = EpisodeBatch.read(motors, motors.keys())
    >>> identify_predictor("motor", Lifting(motors.states), (0,), motors.inputs, batch, internal=2, iterations=0).lifting.states
    ('position', 'velocity', 'current', 'memory_1', 'memory_2')
    """
    units = batch.units
    slowest = 1 - (SHORT / int(batch.lengths.min()) if longest_s is None else batch.sample_period_s / longest_s)
    past = PastMoments.of(lifting, measured, batch, Basis(DELAYS, (slowest,)))
    model = past.model(len(hidden_of(lifting, measured)) + internal, importance=importance, deviation=deviation)
    few = batch.take([i for i in range(len(units)) if units[:i].count(units[i]) < episodes])
    few = few.head(min(samples, int(few.lengths.min())))
    if iterations:
        model, _ = tune_predictor(model, past, few, importance, deviation, slowest, iterations)
    return embedded(name, past, model, inputs, few)


def embedded(
    name: str, past: PastMoments, model: Model, inputs: Sequence[str], batch: EpisodeBatch, ridge: float = RIDGE
) -> Observer:
    """Write a model F, G, H of `PastMoments.model` into an observer; the rows of the measured states are fitted to the recordings."""
    return embedded_with(name, past, model, inputs, batch, (ridge,))[0]


def embedded_with(
    name: str, past: PastMoments, model: Model, inputs: Sequence[str], batch: EpisodeBatch, ridges: Sequence[float]
) -> list[Observer]:
    """Return an observer as of `embedded` for every ridge: the recordings are run along once."""
    from scipy.linalg import null_space

    lifting, measured = past.lifting, past.measured
    n, q, m, hidden = lifting.n_states, len(measured), batch.inputs.shape[-1], hidden_of(lifting, measured)
    F, G, H = model
    internal = len(F) - len(hidden)
    turn = np.vstack([H, null_space(H / np.linalg.norm(H, axis=1)[:, None]).T])
    back = np.linalg.inv(turn)
    F, G = turn @ F @ back, turn @ G
    rows = _measured_rows(
        F, G, past.channels(batch), batch.measurements(measured, arrived=False), batch.states[..., hidden], ridges
    )
    place = [*hidden, *range(n, n + internal)]
    channels = [*range(q), *(q + j for j in past.free), *range(q + m, q + m + len(lifting.functions))]
    widened = replace(lifting, states=(*lifting.states, *(f"memory_{i + 1}" for i in range(internal))))
    silent, dt = np.zeros((len(lifting.functions), widened.n_lifted)), batch.sample_period_s

    def observer(following: Array) -> Observer:
        raw = np.zeros((n + internal, q + m + len(lifting.functions)))  # of y, u and sigma, in place of z
        own = np.zeros((n + internal, n + internal))
        raw[np.ix_(place, channels)], own[np.ix_(place, place)] = G, F
        raw[np.ix_(list(measured), channels)], own[np.ix_(list(measured), place)] = (
            following[:, len(F) :],
            following[:, : len(F)],
        )
        raw[:, q : q + m] -= raw[:, :q] @ past.static
        raw[list(measured), range(q)] += 1.0
        own[:, list(measured)] = raw[:, :q]
        A = np.vstack([np.hstack([own, raw[:, q + m :]]), silent])
        B, D = (np.vstack([M, silent[:, : M.shape[1]]]) for M in (raw[:, q : q + m], raw[:, :q]))
        return Observer(
            name,
            widened,
            A,
            B,
            measured,
            tuple(inputs),
            gain(D, dt),
            Injection.STATE,
            dt,
            replaces=True,
            internal=internal,
        )

    return [observer(following) for following in rows]


def _measured_rows(F: Array, G: Array, z: Array, y: Array, truth: Array, ridges: Sequence[float]) -> list[Array]:
    """Fit the change of the measured states on h and z, shape (q, order + channels), by every ridge; the first states of h are the hidden ones."""
    h = recursion(F, z, np.zeros((z.shape[1], len(F))), G)
    if in_motion(truth):
        missed = (truth - h[..., : truth.shape[-1]]).transpose(2, 1, 0)
        free = FreeStart.of(F, np.eye(truth.shape[-1], len(F)), len(h), FreeStart.by_size(missed))
        h += free.moved(free.fitted(missed)).transpose(2, 1, 0)
    start = skipped(len(z))
    regressors = np.concatenate([h[start:-1:THIN], z[start:-1:THIN]], axis=-1).reshape(-1, len(F) + z.shape[-1])
    change = np.diff(y, axis=0)[start::THIN].reshape(-1, y.shape[-1])
    size = np.sqrt(np.mean(regressors**2, axis=0))
    scaled = regressors / np.where(size > 0, size, 1.0)
    normal, right = scaled.T @ scaled / len(scaled), scaled.T @ change / len(scaled)
    found = [np.linalg.solve(normal + ridge * np.eye(len(size)), right) for ridge in ridges]
    return [np.asarray((rows / np.where(size > 0, size, 1.0)[:, None]).T) for rows in found]
