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
from .problem import RefinementProblem
from .spread import peak_residual_db

Array = npt.NDArray[np.float64]
_TOGETHER = 32  # episodes, as many as the compiled loop runs side by side
_AT_ONCE, _LEAST = 1 << 17, 256  # numbers of recordings and samples in a block


def free_run_errors(
    A: Array,
    B: Array,
    lifting: Lifting,
    parameters: Mapping[str, Array],
    population: Population,
    keys: Sequence[EpisodeKey],
) -> tuple[Array, Array, Array]:
    """Return what the free runs of several models, differ by from one episode of every unit: RMS, largest recorded, reached."""
    n, models = lifting.n_states, len(A)
    rms, reached, top = (
        np.full((models, len(keys), n), np.inf),
        np.full((models, len(keys), n), np.inf),
        np.zeros((len(keys), n)),
    )
    for start in range(0, len(keys), _TOGETHER):
        episodes = {row: population.read(key) for row, key in enumerate(keys[start : start + _TOGETHER], start)}
        by_length: dict[int, list[int]] = {}
        for row, episode in episodes.items():
            by_length.setdefault(len(episode), []).append(row)
        for rows in by_length.values():
            own = {name: np.tile(values[rows], models) for name, values in parameters.items()}
            rms[:, rows], top[rows], reached[:, rows] = _errors(
                A[:, rows], B[:, rows], lifting, own, [episodes[row] for row in rows]
            )
    return rms, top, reached


def _errors(
    A: Array, B: Array, lifting: Lifting, parameters: Mapping[str, Array], episodes: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """Do the same for episodes of one length, in blocks of samples that stay in the cache: a run goes on from its last states."""
    n, h, (models, units), length = lifting.n_states, lifting.history, A.shape[:2], len(episodes[0])
    lifting.window.require(length)
    squares, far, top = np.zeros((n, models, units)), np.zeros((n, models, units)), np.zeros((n, units))
    all_A, all_B = A.reshape(-1, *A.shape[2:]), B.reshape(-1, *B.shape[2:])
    first = np.tile(np.stack([e[: h + 1, :n] for e in episodes]), (models, 1, 1))
    block = max(_LEAST, _AT_ONCE // (models * units * episodes[0].shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(
            0, length - h, block
        ):  # samples k .. stop, of which the last h + 1 are where the next block starts
            stop = min(k + block, length - h) + h
            ahead = min(stop + 1, length)
            u = np.tile(np.stack([e[k:ahead, n:] for e in episodes], axis=-1), (1, 1, models))
            run = free_run(all_A, all_B, lifting, parameters, first, u.transpose(2, 0, 1))
            first = run[:, -(h + 1) :]
            counted = slice(h if k else 0, stop - k)  # what came before was counted with the block before
            x, states = np.stack([e[k:stop, :n][counted] for e in episodes], axis=-1), run.transpose(1, 2, 0)[counted]
            error = states.reshape(len(states), n, models, units) - x[:, :, None]
            squares += np.einsum("kimu,kimu->imu", error, error)
            far = np.maximum(far, np.abs(states).max(axis=0).reshape(far.shape))
            top = np.maximum(top, np.abs(x).max(axis=0))
        rms = np.sqrt(squares / length)
    rms, far = (np.where(np.isfinite(values), values, np.inf).transpose(1, 2, 0) for values in (rms, far))
    return rms, top.T, far


def find_unbounded(
    A: Array,
    B: Array,
    lifting: Lifting,
    parameters: Mapping[str, Array],
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    limit: Array,
) -> dict[int, str]:
    """Run every unit's model, A (unit, n_lifted, n_lifted), over all of its training episodes, and find those whose states leave the limit (n,).

    Returned are, for the rows of these units, the episode, the state and how far it goes.
    """
    found: dict[int, str] = {}
    flat = [(row, key) for row, episodes in enumerate(keys.values()) for key in episodes]
    rows = [row for row, _ in flat]
    own = {name: values[rows] for name, values in parameters.items()}
    _, _, reached = free_run_errors(A[None, rows], B[None, rows], lifting, own, population, [key for _, key in flat])
    for which, state in np.argwhere(~(reached[0] <= limit)):
        row, key = flat[which]
        found.setdefault(
            row,
            f"the free run over {key} reaches {reached[0, which, state]:.3g} in {lifting.states[state]!r}, beyond {limit[state]:.3g}",
        )
    return found


@dataclass(frozen=True, eq=False)
class HeldOutRuns:
    """Scores models on the last training episode of every pooled unit."""

    population: Population
    keys: Mapping[str, Sequence[EpisodeKey]]
    lifting: Lifting
    parameters: Mapping[str, Array]
    rows: npt.NDArray[np.int64]
    problem: RefinementProblem
    scales: tuple[Array, Array]

    def trade_off(self, V: Sequence[Array], strengths: Sequence[float]) -> tuple[TradeOff, ...]:
        """Return accuracy and uncertainty of models (unit, n_lifted, p), or of one for all units."""
        full = np.stack([np.broadcast_to(v, (len(self.keys), *v.shape[-2:]))[self.rows] for v in V])
        models = matrices_of(full, self.problem.T, self.lifting.n_lifted)
        last = [episodes[-1] for episodes in self.keys.values()]
        own = {name: values[self.rows] for name, values in self.parameters.items()}
        ends = [last[row] for row in self.rows]
        rms, top, _ = free_run_errors(models.A, models.B, self.lifting, own, self.population, ends)
        span = np.where(
            top > 0, top, self.scales[0][: self.lifting.n_states]
        )  # a state may rest at zero in the last episode
        percent = np.median(100 * rms / span, axis=1)
        score = np.mean((rms / self.problem.sigma) ** 2, axis=(1, 2))
        return tuple(
            TradeOff(
                float(s),
                tuple(percent[i].tolist()),
                float(score[i]),
                peak_residual_db(models.A[i], models.B[i], *self.scales),
            )
            for i, s in enumerate(strengths)
        )
