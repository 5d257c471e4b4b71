"""Scores of lifted models against recordings: one step ahead, at stated horizons, and over whole free runs.

    horizon h:  x_hat_{k+h} from x_k and inputs k .. k+h-1, compared with x_{k+h}, for every (or every s-th) k
    free run:   x_hat from the first state of the episode and its inputs, compared at every sample, the given ones included

With delays a prediction starts from x_k and the lifting's history before it, and a free run from the first samples that hold one.

Both retract and re-lift at every step. A prediction of sample k + h is compared with the recording at k + h and no other sample, so that an
exact model has error 0 and R^2 = 1. (The scorer of pykoop 2 predicts from unshifted data and compares with shifted data, one sample late.)

Symbols
-------
SSE : sum of squared errors;  SST : sum of squares about the mean of the samples compared;  R^2 = 1 - SSE / SST
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError
from ..lifting import Lifting
from .edmd import KoopmanMatrices
from .free_run import free_run

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
Horizon = int | None  # samples ahead; None is the whole free run
_AT_ONCE = 16_000_000  # numbers of runs in memory


@dataclass(frozen=True, eq=False)
class Scores:
    """Errors of predictions, by episode, horizon and state.

    Parameters
    ----------
    states : tuple of str
    horizons : tuple of int or None
        Samples ahead; None stands for the whole free run.
    squares : ndarray, shape (episode, horizon, n)
        SSE; infinite where a run diverged.
    spread : ndarray, shape (episode, horizon, n)
        SST; exactly zero for a constant state.
    counts : ndarray, shape (episode, horizon)
        Samples compared; zero where the episode is too short for the horizon, and every score there is nan.
    peak : ndarray, shape (episode, n)
        ``max|x|`` over the whole episode.
    """

    states: tuple[str, ...]
    horizons: tuple[Horizon, ...]
    squares: Array
    spread: Array
    counts: npt.NDArray[np.int64]
    peak: Array

    @property
    def rms(self) -> Array:
        """Root mean square error, shape (episode, horizon, n), in the unit of each state."""
        return np.sqrt(_divide(self.squares, self.counts[..., None]))

    @property
    def percent(self) -> Array:
        """``100 rms / max|x|``, shape (episode, horizon, n); nan for a state that is zero throughout."""
        return 100 * _divide(self.rms, self.peak[:, None])

    @property
    def r2(self) -> Array:
        """Coefficient of determination, of shape (episode, horizon, n); nan for a constant state, minus infinity where a run diverged."""
        return 1 - _divide(self.squares, self.spread)

    def pooled(self) -> Scores:
        """Return the scores of all episodes taken together: SSE, SST (about each episode's own mean) and counts add up."""
        return Scores(
            self.states,
            self.horizons,
            self.squares.sum(axis=0, keepdims=True),
            self.spread.sum(axis=0, keepdims=True),
            self.counts.sum(axis=0, keepdims=True),
            self.peak.max(axis=0, keepdims=True),
        )

    def mean(self, measure: str = "percent", state_weights: npt.ArrayLike | None = None) -> Array:
        """Return the mean over the episodes that are long enough, shape (horizon, n), or (horizon,) with weights of the states.

        Parameters
        ----------
        measure : str
            ``percent``, ``rms`` or ``r2``.
        state_weights : array_like, shape (n,), optional
            Not negative, with a positive sum; states of weight zero do not count, whatever their score.
        """
        if measure not in ("percent", "rms", "r2"):
            raise DimensionError(f"Scores: measure {measure!r} is unknown; use percent, rms or r2.")
        values = getattr(self, measure)
        long_enough = self.counts[..., None] > 0
        means = _divide(np.where(long_enough, values, 0.0).sum(axis=0), long_enough.sum(axis=0))
        return means if state_weights is None else weighted_mean(means, state_weights)


def weighted_mean(values: Array, weights: npt.ArrayLike) -> Array:
    """Return the weighted mean over the last axis; entries of weight zero do not count, even where they are nan or infinite."""
    w = np.asarray(weights, dtype=float)
    if w.shape != values.shape[-1:] or not (np.isfinite(w).all() and (w >= 0).all() and w.sum() > 0):
        raise DimensionError(
            f"Weighted mean: {values.shape[-1]} values need as many weights, finite, not negative and not all zero, found {w.tolist()}."
        )
    return np.asarray(values[..., w > 0] @ (w[w > 0] / w.sum()))


def score(
    models: KoopmanMatrices,
    lifting: Lifting,
    parameters: Mapping[str, npt.ArrayLike],
    episodes: Sequence[tuple[Array, Array]],
    horizons: Sequence[Horizon] = (1, None),
    stride: int = 1,
) -> Scores:
    """Score models against recordings.

    Parameters
    ----------
    models : KoopmanMatrices
        One model for all episodes, A (n, n), or one for each, A (episode, n, n).
    lifting : Lifting
    parameters : mapping of str to array_like, shape () or (episode,)
    episodes : sequence of (states, inputs)
        Of shapes (n_samples, n) and (n_samples, m).
    horizons : sequence of int or None
        Samples ahead, at least 1; None is the whole free run.
    stride : int
        Predictions ahead start at every `stride`-th sample.

    Returns
    -------
    Scores
        Where an episode has fewer than ``history + horizon + 1`` samples its count is zero, which is logged.

    Raises
    ------
    DataError
        When no episode is long enough for one of the horizons.
    DimensionError
        When horizons, stride, models and episodes do not fit together.

    Examples
    --------
    >>> u = np.ones((50, 1))
    >>> x = 1 - 0.5 ** np.arange(50.0)[:, None]
    >>> model = KoopmanMatrices(np.array([[0.5]]), np.array([[0.5]]))
    >>> float(score(model, Lifting(("x",)), {}, [(x, u)], horizons=(1, 10)).percent.max())
    0.0
    """
    scores = score_long_enough(models, lifting, parameters, episodes, horizons, stride)
    for column, horizon in enumerate(scores.horizons):
        if not scores.counts[:, column].any():
            raise DataError(
                f"Scores: horizon {horizon} needs episodes of {lifting.history + (horizon or 1) + 1} samples or more, the longest has "
                f"{max(len(x) for x, _ in episodes)}; ask for a shorter horizon."
            )
    return scores


def score_long_enough(
    models: KoopmanMatrices,
    lifting: Lifting,
    parameters: Mapping[str, npt.ArrayLike],
    episodes: Sequence[tuple[Array, Array]],
    horizons: Sequence[Horizon],
    stride: int = 1,
) -> Scores:
    """Score as `score` does, and leave a horizon uncounted where no episode is long enough."""
    horizons = tuple(horizons)
    _check(models, lifting, episodes, horizons, stride)
    n, many = lifting.n_states, len(episodes)
    own = {name: np.broadcast_to(np.asarray(parameters[name], dtype=float), (many,)) for name in lifting.parameters}
    squares, spread = np.full((many, len(horizons), n), np.nan), np.full((many, len(horizons), n), np.nan)
    counts = np.zeros((many, len(horizons)), dtype=np.int64)
    for column, horizon in enumerate(horizons):
        found = _free(models, lifting, own, episodes) if horizon is None else _ahead(models, lifting, own, episodes, horizon, stride)
        for row, run, truth in found:
            squares[row, column], spread[row, column], counts[row, column] = _squares(run, truth), _spread(truth), len(truth)
    short = np.argwhere(counts == 0)
    for row, column in short:
        log.info("episode %d of %d has %d samples, too few for horizon %s", row, many, len(episodes[row][0]), horizons[column])
    skipped = counts[..., None] == 0
    peak = np.array([np.abs(x).max(axis=0, initial=0.0) for x, _ in episodes])
    return Scores(lifting.states, horizons, np.where(skipped, 0.0, squares), np.where(skipped, 0.0, spread), counts, peak)


def predict_ahead(
    models: KoopmanMatrices, lifting: Lifting, parameters: Mapping[str, npt.ArrayLike], x: Array, u: Array, horizon: int, stride: int = 1
) -> Array:
    """Predict one episode from every `stride`-th sample, all starts side by side.

    Parameters
    ----------
    models : KoopmanMatrices
        One model.
    lifting : Lifting
    parameters : mapping of str to array_like, shape ()
    x : ndarray, shape (n_samples, n)
    u : ndarray, shape (n_samples, m)
    horizon : int
    stride : int

    Returns
    -------
    ndarray, shape (n_starts, n)
        Row i is the prediction of sample ``history + i * stride + horizon``, to be compared with ``x[history + horizon::stride]``.
    """
    past = lifting.history
    if len(x) <= past + horizon:
        return np.zeros((0, x.shape[1]))
    view = np.lib.stride_tricks.sliding_window_view
    starts = np.moveaxis(view(x[: len(x) - horizon], past + 1, axis=0)[::stride], -1, 1)  # (start, past + 1, n)
    inputs = np.moveaxis(view(u, past + horizon + 1, axis=0)[::stride], -1, 1)  # (start, past + horizon + 1, m)
    step = max(1, _AT_ONCE // (inputs.shape[1] * (x.shape[1] + u.shape[1])))
    ends = np.empty((len(starts), x.shape[1]))
    for start in range(0, len(starts), step):
        part = slice(start, start + step)
        own = {name: np.full(len(starts[part]), float(np.asarray(parameters[name]))) for name in lifting.parameters}
        ends[part] = free_run(models.A, models.B, lifting, own, np.ascontiguousarray(starts[part]), inputs[part])[:, -1]
    return ends


def _ahead(
    models: KoopmanMatrices, lifting: Lifting, own: Mapping[str, Array], episodes: Sequence[tuple[Array, Array]], horizon: int, stride: int
) -> Iterator[tuple[int, Array, Array]]:
    """Yield row, prediction and truth of every episode that is long enough."""
    for row, (x, u) in enumerate(episodes):
        if len(x) > lifting.history + horizon:
            model = models if models.A.ndim == 2 else KoopmanMatrices(models.A[row], models.B[row])
            values = {name: value[row] for name, value in own.items()}
            yield row, predict_ahead(model, lifting, values, x, u, horizon, stride), x[lifting.history + horizon :: stride]


def _free(
    models: KoopmanMatrices, lifting: Lifting, own: Mapping[str, Array], episodes: Sequence[tuple[Array, Array]]
) -> Iterator[tuple[int, Array, Array]]:
    """Yield row, free run and truth of every episode; episodes of like length run side by side."""
    order = sorted((row for row, (x, _) in enumerate(episodes) if len(x) > lifting.history + 1), key=lambda row: -len(episodes[row][0]))
    while order:
        longest, width = len(episodes[order[0]][0]), sum(part.shape[1] for part in episodes[order[0]])
        count = max(1, _AT_ONCE // (longest * width))
        rows, order = order[:count], order[count:]
        u = np.zeros((len(rows), longest, episodes[rows[0]][1].shape[1]))
        for i, row in enumerate(rows):
            u[i, : len(episodes[row][1])] = episodes[row][1]
        A, B = (models.A, models.B) if models.A.ndim == 2 else (models.A[rows], models.B[rows])
        x0 = np.stack([episodes[row][0][: lifting.history + 1] for row in rows])
        run = free_run(A, B, lifting, {name: value[rows] for name, value in own.items()}, x0, u)
        for i, row in enumerate(rows):
            x = episodes[row][0]
            yield row, run[i, : len(x)], x


def _squares(run: Array, truth: Array) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        sums = np.sum((run - truth) ** 2, axis=0)
    return np.where(np.isfinite(sums), sums, np.inf)


def _spread(truth: Array) -> Array:
    """SST; the mean of a constant column may round, its spread may not."""
    varies = truth.max(axis=0) > truth.min(axis=0)
    return np.asarray(np.where(varies, np.sum((truth - truth.mean(axis=0)) ** 2, axis=0), 0.0))


def _divide(numerator: Array, denominator: npt.ArrayLike) -> Array:
    """Quotient that is nan, without a warning, where the denominator is zero."""
    below = np.broadcast_to(np.asarray(denominator, dtype=float), np.shape(numerator))
    return np.divide(numerator, below, out=np.full(np.shape(numerator), np.nan), where=below != 0)


def _check(
    models: KoopmanMatrices, lifting: Lifting, episodes: Sequence[tuple[Array, Array]], horizons: tuple[Horizon, ...], stride: int
) -> None:
    if not episodes or not horizons or stride < 1 or any(h is not None and h < 1 for h in horizons):
        raise DimensionError(
            f"Scores: need episodes, horizons of at least one sample and a stride of at least 1, found {len(episodes)} episodes, horizons "
            f"{horizons}, stride {stride}."
        )
    batch, m = models.A.shape[:-2], models.B.shape[-1] - len(lifting.input_functions)
    wrong = [i for i, (x, u) in enumerate(episodes) if x.shape[1:] != (lifting.n_states,) or u.shape != (len(x), m)]
    if batch not in ((), (len(episodes),)) or models.A.shape[-1] != lifting.n_lifted or wrong:
        raise DimensionError(
            f"Scores: A {models.A.shape} and B {models.B.shape} should be one model, or one for each of {len(episodes)} episodes, for a lifting of "
            f"{lifting.n_states} states to {lifting.n_lifted}; episodes that do not fit: {wrong[:5]}."
        )
