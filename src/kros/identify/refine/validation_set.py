"""Free runs over whole training episodes: the held-out error, and the check that runs stay bounded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ...core.errors import IdentificationError
from ...data.population import EpisodeKey, Population
from ...lifting import Lifting
from ..edmd import KoopmanMatrices
from ..free_run import free_run
from .metric import peak_residual_db
from .model import TradeOff, TrainingData
from .problem import RefinementProblem

Array = npt.NDArray[np.float64]
_TOGETHER = 32  # episodes, as many as the compiled loop runs side by side


def free_run_errors(
    models: KoopmanMatrices,
    lifting: Lifting,
    parameters: Mapping[str, Array],
    population: Population,
    keys: Sequence[EpisodeKey],
) -> tuple[Array, Array, Array]:
    """Return RMS errors of free runs, and the largest recorded and reached values, all (episode, n)."""
    shape = len(keys), lifting.n_states
    rms, top, reached = np.full(shape, np.inf), np.zeros(shape), np.full(shape, np.inf)
    for start in range(0, len(keys), _TOGETHER):
        episodes = {row: population.read(key) for row, key in enumerate(keys[start : start + _TOGETHER], start)}
        by_length: dict[int, list[int]] = {}
        for row, episode in episodes.items():
            by_length.setdefault(len(episode), []).append(row)
        for rows in by_length.values():
            values = {name: given[rows] for name, given in parameters.items()}
            part = KoopmanMatrices(models.A[rows], models.B[rows])
            rms[rows], top[rows], reached[rows] = _errors(part, lifting, values, [episodes[row] for row in rows])
    return rms, top, reached


def _errors(
    models: KoopmanMatrices, lifting: Lifting, parameters: Mapping[str, Array], episodes: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """Do the same for episodes of one length."""
    n, h, recorded = lifting.n_states, lifting.history, np.stack(episodes)
    x = recorded[..., :n]
    run = free_run(models.A, models.B, lifting, parameters, x[:, : h + 1], recorded[..., n:])
    with np.errstate(over="ignore", invalid="ignore"):
        rms = np.sqrt(np.mean((run - x) ** 2, axis=1))
        sizes = rms, np.abs(run).max(axis=1)
    rms, reached = (np.where(np.isfinite(values), values, np.inf) for values in sizes)
    return rms, np.abs(x).max(axis=1), reached


def require_bounded(data: TrainingData, models: KoopmanMatrices, bound: float) -> None:
    """Refuse models whose free runs over a training episode leave the bound, in ranges of the states."""
    rows = [row for row, episodes in enumerate(data.keys.values()) for _ in episodes]
    keys = [key for episodes in data.keys.values() for key in episodes]
    values = {name: given[rows] for name, given in data.parameters.items()}
    each = KoopmanMatrices(models.A[rows], models.B[rows])
    _, _, reached = free_run_errors(each, data.lifting, values, data.population, keys)
    for which, state in np.argwhere(~(reached <= bound)):
        size = f"{reached[which, state]:.3g} times the range of {data.lifting.states[state]!r}, beyond {bound:g}"
        remedy = "use functions that stay bounded, drop the episode, or set identify.refine = false"
        raise IdentificationError(f"Refinement: the free run over {keys[which]} reaches {size}; {remedy}.")


def trade_off(data: TrainingData, problem: RefinementProblem, V: Array, strength: float) -> TradeOff:
    """Return accuracy on held-out training episodes, and uncertainty, of models (unit, n_lifted, p) or one for all."""
    rows, count = data.rows, len(data.keys)
    models = problem.matrices(np.broadcast_to(V, (count, *V.shape[-2:]))[rows])
    last = [episodes[-1] for episodes in data.keys.values()]
    values = {name: given[rows] for name, given in data.parameters.items()}
    rms, top, _ = free_run_errors(models, data.lifting, values, data.population, [last[row] for row in rows])
    percent = np.median(100 * rms / np.where(top > 0, top, 1.0), axis=0)  # a state may rest at zero in the last episode
    score = np.mean((rms / problem.sigma) ** 2)
    return TradeOff(strength, tuple(percent.tolist()), float(score), peak_residual_db(models.A, models.B))
