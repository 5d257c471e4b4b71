"""Free runs over whole training episodes: the held-out error that chooses the prior's strength, and the check that runs stay bounded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...data.population import EpisodeKey, Population
from ...lifting import Lifting
from ..free_run import free_run
from .model import TradeOff
from .pooled import matrices_of
from .problem import Problem
from .spread import peak_residual_db

Array = npt.NDArray[np.float64]
_AT_ONCE = 4_000_000  # numbers of recordings in memory


def free_run_errors(
    A: Array,
    B: Array,
    lifting: Lifting,
    parameters: Mapping[str, Array],
    population: Population,
    keys: Sequence[EpisodeKey],
    validation_samples: int | None = None,
) -> tuple[Array, Array, Array]:
    """Return what the free runs of several models, A (model, unit, n_lifted, n_lifted), differ by from one episode of every unit.

    That is the RMS of the error (model, unit, n), infinite where a run diverged, the largest magnitude recorded (unit, n), and that of the run
    (model, unit, n). Of each episode `validation_samples` are run, those before a free run's start not counted; all by default.
    """
    n, h, models = lifting.n_states, lifting.history, len(A)
    rms, reached, top = np.full((models, len(keys), n), np.inf), np.full((models, len(keys), n), np.inf), np.zeros((len(keys), n))
    episodes = [population.read(key)[: None if validation_samples is None else h + validation_samples] for key in keys]
    by_length: dict[int, list[int]] = {}
    for row, episode in enumerate(episodes):
        by_length.setdefault(len(episode), []).append(row)
    for length, same in by_length.items():
        step = max(1, _AT_ONCE // (length * models * episodes[same[0]].shape[1]))
        for rows in (same[i : i + step] for i in range(0, len(same), step)):
            data = np.stack([episodes[row] for row in rows])
            x, u = data[..., :n], data[..., n:]
            top[rows] = np.abs(x).max(axis=1)
            own = {name: np.tile(values[rows], models) for name, values in parameters.items()}
            run = free_run(
                A[:, rows].reshape(-1, *A.shape[2:]),
                B[:, rows].reshape(-1, *B.shape[2:]),
                lifting,
                own,
                np.tile(x[:, : h + 1], (models, 1, 1)),
                np.tile(u, (models, 1, 1)),
            ).reshape(models, *x.shape)
            with np.errstate(over="ignore", invalid="ignore"):
                found, far = np.sqrt(np.mean((run - x) ** 2, axis=2)), np.abs(run).max(axis=2)
            rms[:, rows] = np.where(np.isfinite(found), found, np.inf)
            reached[:, rows] = np.where(np.isfinite(far), far, np.inf)
    return rms, top, reached


def find_unbounded(
    A: Array,
    B: Array,
    lifting: Lifting,
    parameters: Mapping[str, Array],
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    limit: Array,
    validation_samples: int | None = None,
) -> dict[int, str]:
    """Run every unit's model, A (unit, n_lifted, n_lifted), over all of its training episodes, and find those whose states leave the limit (n,).

    Returned are, for the rows of these units, the episode, the state and how far it goes.
    """
    found: dict[int, str] = {}
    flat = [(row, key) for row, episodes in enumerate(keys.values()) for key in episodes]
    width = max(1, _AT_ONCE // (len(population.channels) * 20_000))
    for part in (flat[i : i + width] for i in range(0, len(flat), width)):
        rows = [row for row, _ in part]
        own = {name: values[rows] for name, values in parameters.items()}
        _, _, reached = free_run_errors(
            A[None, rows], B[None, rows], lifting, own, population, [key for _, key in part], validation_samples
        )
        for which, state in np.argwhere(~(reached[0] <= limit)):
            row, key = part[which]
            found.setdefault(
                row,
                f"the free run over {key} reaches {reached[0, which, state]:.3g} in {lifting.states[state]!r}, beyond {limit[state]:.3g}",
            )
    return found


@dataclass(frozen=True, eq=False)
class ValidationSet:
    """Scores models on the last training episode of every pooled unit, or on its first `validation_samples` samples."""

    population: Population
    keys: Mapping[str, Sequence[EpisodeKey]]
    lifting: Lifting
    parameters: Mapping[str, Array]
    rows: npt.NDArray[np.int64]
    problem: Problem
    scales: tuple[Array, Array]
    validation_samples: int | None = None

    def trade_off(self, V: Sequence[Array], strengths: Sequence[float]) -> tuple[TradeOff, ...]:
        """Return accuracy and uncertainty of models (unit, n_lifted, p), or of one for all units."""
        full = np.stack([np.broadcast_to(v, (len(self.keys), *v.shape[-2:]))[self.rows] for v in V])
        models = matrices_of(full, self.problem.T, self.lifting.n_lifted)
        last = [episodes[-1] for episodes in self.keys.values()]
        own = {name: values[self.rows] for name, values in self.parameters.items()}
        ends = [last[row] for row in self.rows]
        rms, top, _ = free_run_errors(models.A, models.B, self.lifting, own, self.population, ends, self.validation_samples)
        span = np.where(top > 0, top, self.scales[0][: self.lifting.n_states])  # a state may rest at zero in the last episode
        percent = np.median(100 * rms / span, axis=1)
        score = np.mean((rms / self.problem.sigma) ** 2, axis=(1, 2))
        return tuple(
            TradeOff(float(s), tuple(percent[i].tolist()), float(score[i]), peak_residual_db(models.A[i], models.B[i], *self.scales))
            for i, s in enumerate(strengths)
        )
