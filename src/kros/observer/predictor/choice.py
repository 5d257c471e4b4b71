"""Choosing a predictor's memory, weights of conditions and order: by the errors on units that had no part in it.

What is regressed on the whole basis costs no run: the moments of the units that are left out say what it misses there. So the lags, the delays, the
weight of every condition for every hidden state, and the deviation of lifted functions are compared with all of the past; orders then with models that run.

What recordings say of machines that come to a limit of a hidden state depends on these. Where a controller winds up, what it does later says little of what
it does within: such recordings count until the limit is met (`until`). A machine without one forgets its limit, and all of its recordings count
(`filled_in`): an estimate that will be cut off is right at the limit however far beyond it is, so that what the limit hides is what the regression says of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...data import EpisodeBatch
from ...synthesis.residual_shaped.shaping_filter import Basis
from ..tuning.blocks import Array, Model, blocks_of, estimates_along
from .free_start import FreeStart, in_motion
from .moments import PastMoments, hidden_of, limited

Flags = npt.NDArray[np.bool_]
FOLDS = 3
SHARES = (0.0, 0.3, 1.0)  # of the other conditions in training
DEVIATIONS = (0.0, 0.2, 0.4)
AS_GOOD = 0.003  # difference of logarithms that is worth no longer memory, and no more states
NEAR = 0.03  # share of a limit that may have touched it, noise taken off
_FILLED = 2  # times that what limits hide is filled in
AT_LIMITS = 0.25  # weight of what machines do after they have come to a limit, beside what they do before


@dataclass(frozen=True)
class Recipe:
    """What `PastMoments.model` needs to know."""

    basis: Basis
    weights: Mapping[str, tuple[float, ...]]  # of every condition, one for every hidden state
    deviation: float  # share by which the lifted functions' effect may differ from machine to machine
    internal: int  # states besides the recorded ones
    held_out: tuple[float, ...]  # root mean square errors of the hidden states on units that were left out

    def model(self, past: PastMoments, importance: npt.ArrayLike = 1.0) -> Model:
        """Return the model that the moments of all units give."""
        order = past.power.shape[1] + self.internal
        return past.restricted(self.basis).model(order, (), importance, self.deviation, self.weights)


def filled(past: PastMoments, W: Array, lower: Array, upper: Array, batch: EpisodeBatch) -> EpisodeBatch:
    """Return recordings with hidden states beyond their limits, shape (n_states,), where they are at them and a regression on the past says so."""
    hidden, z, states = hidden_of(past.lifting, past.measured), past.channels(batch), batch.states.copy()
    low, high = at_limits(batch.states, lower, upper)
    for i in range(len(batch.keys)):
        rows = np.flatnonzero((low | high)[:, i][:, hidden].any(axis=1))
        said, own = past.states_at(z[:, i], rows) @ W.T, states[rows, i][:, hidden]
        own = np.where(high[rows, i][:, hidden], np.maximum(own, said), own)
        states[rows[:, None], i, hidden] = np.where(low[rows, i][:, hidden], np.minimum(own, said), own)
    return replace(batch, states=states)


def at_limits(states: Array, lower: Array, upper: Array) -> tuple[Flags, Flags]:
    """Return which states are at their lower limits, and which at the upper ones."""
    return states <= lower * (1 + NEAR * np.sign(lower)), states >= upper * (1 - NEAR * np.sign(upper))


def filled_in(
    past: PastMoments, batch: EpisodeBatch, lower: Array, upper: Array
) -> tuple[PastMoments, Callable[[EpisodeBatch], EpisodeBatch]]:
    """Return moments of recordings with what limits hide filled in: censored regression by EM."""
    of = partial(PastMoments.of, past.lifting, past.measured, basis=past.basis)
    whole = of(batch, without=np.any(at_limits(batch.states, lower, upper), axis=(0, -1)))
    for _ in range(_FILLED):
        fill = partial(filled, whole, whole.regression()[0], lower, upper)
        whole = of(fill(batch))
    return whole, fill


def choose(
    past: PastMoments,
    batch: EpisodeBatch,
    emphasis: Mapping[str, npt.ArrayLike],
    importance: npt.ArrayLike = 1.0,
    delays: Sequence[int] = (),
    lags: Sequence[tuple[float, ...]] = (),
    internal: Sequence[int] = (12,),
    until: npt.ArrayLike | None = None,
) -> Recipe:
    """Choose a recipe on units that are left out in turn."""
    stressed = {c: np.broadcast_to(np.asarray(own, dtype=float), past.power.shape[1:]) for c, own in emphasis.items()}
    share = np.broadcast_to(np.asarray(importance, dtype=float), past.power.shape[1:])
    share = share / share.sum()
    first = next(iter(stressed))
    beyond = {limited(c) for c in stressed}
    others = [c for c in stressed if c not in (first, limited(first))]
    delays, lags = delays or (past.basis.delays,), lags or (past.basis.poles,)
    shares = SHARES if others else (0.0,)

    def weights(of_states: npt.ArrayLike) -> dict[str, tuple[float, ...]]:
        own = {c: of_states if c in others else 1.0 for c in stressed}
        return {
            c: tuple(map(float, np.where(counts > 0, own[c], 0.0) * (AT_LIMITS if c in beyond else 1.0)))
            for c, counts in stressed.items()
        }

    def judged(basis: Basis, of_states: npt.ArrayLike, deviation: float) -> Array:
        part, given = past.restricted(basis), weights(of_states)
        return _held_out(
            past, stressed, lambda units, rows: part.errors(part.regression(units, deviation, given)[0])[rows]
        )

    tried = {poles: np.array([judged(Basis(delays[0], poles), s, DEVIATIONS[-1]) for s in shares]) for poles in lags}
    poles = lags[_first_good(np.array([[share @ tried[p].min(axis=0)] for p in lags]))]
    own = np.asarray(shares)[tried[poles].argmin(axis=0)]
    basis = Basis(delays[0], poles)
    deviations = DEVIATIONS if past.lifting.functions else (0.0,)
    deviation = deviations[int(np.argmin([share @ judged(basis, own, deviation) for deviation in deviations]))]
    if len(delays) > 1:
        basis = Basis(delays[_first_good(np.array([judged(Basis(d, poles), own, deviation) for d in delays]))], poles)
    errors = _orders(past.restricted(basis), batch, stressed, share, weights(own), deviation, internal, until)
    best = _first_good(np.array(errors))
    return Recipe(basis, weights(own), deviation, internal[best], tuple(np.exp(errors[best]).tolist()))


def _orders(
    past: PastMoments,
    batch: EpisodeBatch,
    emphasis: Mapping[str, Array],
    share: Array,
    weights: Mapping[str, tuple[float, ...]],
    deviation: float,
    internal: Sequence[int],
    until: npt.ArrayLike | None,
) -> list[Array]:
    """Errors of models of several orders that run on units without which they were made, shape (h,) each, as logarithms."""
    rows, hidden = list(zip(past.units, past.conditions, strict=True)), hidden_of(past.lifting, past.measured)
    ends = batch.lengths if until is None else np.minimum(np.asarray(until), batch.lengths)
    pieces = [(i, (key.unit, key.condition), 0, int(ends[i])) for i, key in enumerate(batch.keys)]
    pieces += [
        (i, (key.unit, limited(key.condition)), int(ends[i]), int(batch.lengths[i])) for i, key in enumerate(batch.keys)
    ]
    pieces = [piece for piece in pieces if piece[3] > piece[2] and piece[1] in rows]

    def missed(units: Sequence[str], which: list[int]) -> Array:
        own = [piece for piece in pieces if rows.index(piece[1]) in which]
        runs = sorted({i for i, *_ in own})
        held, total, count = batch.take(runs), np.zeros((len(internal), len(rows), len(hidden))), np.zeros(len(rows))
        for _, name, start, end in own:
            count[rows.index(name)] += end - start
        balanced, truth = past.balanced(units, share, deviation, weights), held.states[..., hidden]
        z = np.ascontiguousarray(past.channels(held).transpose(2, 1, 0))
        lifted, at_rest = slice(len(z) - len(past.lifting.functions), None), np.zeros(z.shape[:2])
        at_rest[lifted] = z[lifted, :, 0]
        for n, memories in enumerate(internal):
            error = missed_by(balanced.model(len(hidden) + memories), z, at_rest, truth)
            for i, name, start, end in own:
                total[n, rows.index(name)] += np.sum(error[:, runs.index(i), start:end] ** 2, axis=-1)
        found = total / np.where(count > 0, count, np.nan)[:, None]
        return np.moveaxis(found, 0, -1)[which]

    return list(_held_out(past, emphasis, missed).T)


def _held_out(
    past: PastMoments, emphasis: Mapping[str, Array], missed: Callable[[list[str], list[int]], Array]
) -> Array:
    """Mean over units, weighted over conditions, of logarithms of root mean square errors on units left out, shape (h, ...) as a row of `missed`."""
    names = list(dict.fromkeys(past.units))
    folds = [names[i::FOLDS] for i in range(min(FOLDS, len(names)))]
    found: dict[int, Array] = {}
    for fold in folds:
        rows = [i for i, unit in enumerate(past.units) if unit in fold]
        found |= dict(zip(rows, missed(fold if len(names) > 1 else [], rows), strict=True))
    total: Array = np.zeros(1)
    weights: Array = np.zeros(1)
    for condition, counts in emphasis.items():
        own = [
            found[i] for i, other in enumerate(past.conditions) if other == condition and np.isfinite(found[i]).all()
        ]
        if own:
            shape = (-1,) + (1,) * (own[0].ndim - 1)
            total = total + counts.reshape(shape) * np.mean(np.log(own), axis=0) / 2
            weights = weights + counts.reshape(shape)
    if not weights.any():
        raise DataError(
            "Predictor: no unit that is left out can be judged by the others; record more units, or movements that stay off the limits."
        )
    return np.asarray(total / weights)


def _first_good(scores: Array) -> int:
    """Return which is the first candidate, shape (candidate, h), that is as good as the best ones for every hidden state; else the best in the mean."""
    good = np.flatnonzero((scores <= scores.min(axis=0) + AS_GOOD).all(axis=1))
    return int(good[0] if len(good) else scores.mean(axis=1).argmin())


def missed_by(model: Model, z: Array, rest: Array, truth: Array) -> Array:
    """Return the errors of a model's estimates, shape (h, batch, n_samples), from rest or the best start."""
    missed = truth.transpose(2, 1, 0) - estimates_along(blocks_of(*model), z, rest)
    if in_motion(truth):
        return FreeStart.of(model[0], model[2], len(truth), FreeStart.by_size(missed)).without(missed)
    return np.asarray(missed)
