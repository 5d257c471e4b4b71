"""Training of the learned estimator, from the moments that every unit leaves of all its samples.

An estimator trained without a unit costs one solution of the normal equations. How many samples of the past count, how much weights are penalised, and
whether all conditions are trained on or one alone is chosen for every estimated state, by the errors in all conditions on units that were left out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...data import EpisodeBatch
from ...data.batch import hold_missing
from .learned import Features, Learned

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.intp]
RIDGE = 1e-5
_TAPS = (5, 10, 20, 40, 80)
_RIDGES = (1e-10, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
_FOLDS = 4
_BLOCKS = 3 * _FOLDS


@dataclass(frozen=True)
class Choice:
    """How one state is estimated."""

    taps: int
    ridge: float
    condition: str | None = None


@dataclass(frozen=True, eq=False)
class Moments:
    """What every unit leaves of its training episodes in every condition: means of products of regressors and estimated states."""

    features: Features
    estimated: tuple[int, ...]
    groups: tuple[tuple[str, str], ...]
    gram: Array  # (group, h, 1 + f, 1 + f)
    cross: Array  # (group, h, 1 + f)
    power: Array  # (group, h)

    @classmethod
    def of(cls, features: Features, batches: Iterable[EpisodeBatch], least: Array | None = None) -> Moments:
        """Collect the moments of training episodes, every sample from the first on; all episodes of a unit and condition count the same."""
        n = features.lifting.n_states
        estimated = [i for i in range(n) if i not in features.measured]
        if not estimated:
            raise DataError("Learned estimator: every state is measured, there is nothing to estimate.")
        floor = np.finfo(float).tiny + (np.zeros(n) if least is None else least)[estimated]
        found: dict[tuple[str, str], tuple[Array, Array, Array]] = {}
        counts: dict[tuple[str, str], int] = {}
        for batch in batches:
            z = features.channels(hold_missing(batch.measurements(features.measured)), batch.inputs, batch.parameters)
            for i, (key, length) in enumerate(zip(batch.keys, batch.lengths.tolist(), strict=True)):
                truth = batch.states[:length, i][:, estimated]
                size = np.maximum(np.abs(truth).max(axis=0), floor)
                gram, cross, power = episode_moments(z[:length, i], truth / size, features.taps)
                group, h = (key.unit, key.condition), len(estimated)
                if group not in found:
                    found[group] = np.zeros((h, *gram.shape)), np.zeros((h, len(gram))), np.zeros(h)
                for into, new in zip(
                    found[group], (gram / size[:, None, None] ** 2, cross.T / size[:, None], power), strict=True
                ):
                    into += new
                counts[group] = counts.get(group, 0) + 1
        for group, own in found.items():
            for part in own:
                part /= counts[group]
        gram, cross, power = (np.stack([own[part] for own in found.values()]) for part in range(3))
        return cls(features, tuple(estimated), tuple(found), gram, cross, power)

    @property
    def units(self) -> tuple[str, ...]:
        """Units in order of appearance."""
        return tuple(dict.fromkeys(unit for unit, _ in self.groups))

    def choose(self) -> tuple[Choice, ...]:
        """Return for every estimated state the choice with the least mean error on units left out in folds, the geometric mean over conditions."""
        folds = [self.units[fold::_FOLDS] for fold in range(min(_FOLDS, len(self.units)))]
        if len(folds) < 2:
            return (Choice(self.features.taps, RIDGE),) * len(self.estimated)
        conditions = sorted({condition for _, condition in self.groups})
        taps = sorted({min(taps, self.features.taps) for taps in _TAPS})
        trained = (None, *conditions) if len(conditions) > 1 else (None,)
        tried = [Choice(*settings) for settings in product(taps, _RIDGES, trained)]
        errors = np.zeros((len(self.estimated), len(tried), len(self.groups)))
        for fold, state in product(folds, range(len(self.estimated))):
            held = [i for i, (unit, _) in enumerate(self.groups) if unit in fold]
            means = {condition: self._means(state, fold, condition) for condition in trained}
            for count in taps:
                used, own = self._used(count), [i for i, choice in enumerate(tried) if choice.taps == count]
                found = {
                    c: solved(gram[np.ix_(used, used)], cross[used], _RIDGES) for c, (gram, cross) in means.items()
                }
                weights = np.stack([found[tried[i].condition][_RIDGES.index(tried[i].ridge)] for i in own])
                errors[state][np.ix_(own, held)] = np.stack(
                    [self._error(group, state, used, weights) for group in held], axis=1
                )
        members = [[i for i, group in enumerate(self.groups) if group[1] == condition] for condition in conditions]
        scores = sum(np.log(errors[..., rows].mean(axis=-1)) for rows in members)
        return tuple(tried[i] for i in np.argmin(scores, axis=-1))

    def _error(self, group: int, state: int, used: Whole, weights: Array) -> Array:
        """RMS errors of weights, shape (choice, used), in the episodes of a group."""
        gram, cross = self.gram[group, state], self.cross[group, state, used]
        gram = gram if len(used) == len(gram) else gram[np.ix_(used, used)]
        missed = self.power[group, state] - 2 * weights @ cross + np.einsum("tf,tf->t", weights @ gram, weights)
        return np.asarray(np.sqrt(np.maximum(missed, np.finfo(float).tiny)))

    def estimator(self, without: Collection[str] = (), choices: Sequence[Choice] | None = None) -> Learned:
        """Train on all units but some; names of units that took no part are ignored."""
        if not set(self.units) - set(without):
            raise DataError(
                f"Learned estimator: no unit is left to train on without {', '.join(sorted(without))}; record more units."
            )
        taps, h = self.features.taps, len(self.estimated)
        chosen = choices or (Choice(taps, RIDGE),) * h
        weights = np.zeros((self.gram.shape[-1], h))
        for state, choice in enumerate(chosen):
            used, (gram, cross) = self._used(choice.taps), self._means(state, without, choice.condition)
            (weights[used, state],) = solved(gram[np.ix_(used, used)], cross[used], [choice.ridge])
        response = weights[1:].reshape(-1, taps, h).copy()
        response[:, :-1] -= weights[1:].reshape(-1, taps, h)[:, 1:]
        return Learned(self.features, self.estimated, weights[0], response)

    def _used(self, taps: int) -> Whole:
        """Regressors of so many samples of the past: the constant and those lags of every channel."""
        return np.concatenate([[0], 1 + np.flatnonzero(np.arange(self.gram.shape[-1] - 1) % self.features.taps < taps)])

    @cached_property
    def _blocks(self) -> list[tuple[list[int], Array, Array]]:
        """Groups of some units in one condition, all of one fold, and the sums of their moments."""
        rows: dict[tuple[int, str], list[int]] = {}
        number = {unit: i for i, unit in enumerate(self.units)}
        for i, (unit, condition) in enumerate(self.groups):
            rows.setdefault((number[unit] % _BLOCKS, condition), []).append(i)
        return [(own, _sum(self.gram, own), _sum(self.cross, own)) for own in rows.values()]

    def _means(self, state: int, without: Collection[str], condition: str | None) -> tuple[Array, Array]:
        """Return the mean moments of all other units in one condition or all, shapes (1 + f, 1 + f) and (1 + f,)."""
        others = [i for i, (unit, _) in enumerate(self.groups) if unit not in without]
        rows = [i for i in others if condition in (None, self.groups[i][1])] or others
        wanted, gram, cross = set(rows), np.zeros(self.gram.shape[2:]), np.zeros(self.cross.shape[2:])
        for own, gram_of_block, cross_of_block in self._blocks:
            if wanted.issuperset(own):
                gram += gram_of_block[state]
                cross += cross_of_block[state]
                continue
            for i in (i for i in own if i in wanted):
                gram += self.gram[i, state]
                cross += self.cross[i, state]
        return gram / len(rows), cross / len(rows)


def _sum(moments: Array, groups: Sequence[int]) -> Array:
    if len(groups) == 1:
        return np.asarray(moments[groups[0]])  # no copy: with few units these are all of them
    total = np.zeros(moments.shape[1:])
    for i in groups:
        total += moments[i]
    return total


def solved(gram: Array, cross: Array, ridges: Sequence[float]) -> Array:
    """Solve the normal equations for some penalties, shape (ridge, 1 + f); that of the constant is not penalised."""
    from scipy.linalg.lapack import dposv

    size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    scaled, sought, found = gram / np.outer(size, size), cross / size, []
    penalised = np.arange(1, len(size))
    for ridge in ridges:
        matrix = scaled.copy()
        matrix[penalised, penalised] += ridge
        _, weights, failed = dposv(matrix.T, sought, overwrite_a=False)
        found.append((np.linalg.solve(matrix, sought) if failed else weights) / size)
    return np.array(found)


def episode_moments(z: Array, truth: Array, taps: int) -> tuple[Array, Array, Array]:
    """Return the moments of one episode; regressors of row k are 1, ``z[k-1]`` and ``z[k-1-j] - z[k-j]`` for j = 1, ..., taps - 1."""
    (n_samples, c), h, behind = z.shape, truth.shape[1], taps - 1
    step = np.zeros((c, behind + n_samples))
    step[:, behind + 1 :] = (z[:-1] - z[1:]).T
    latest = np.concatenate([z[:1], z[:-1]])
    newest = step[:, behind - 1 : behind - 1 + n_samples] if behind else step[:0]
    signals = np.concatenate([np.ones((1, n_samples)), latest.T, truth.T, newest])
    known, state, own = slice(1 + c), slice(1 + c, 1 + c + h), slice(1 + c + h, None)
    level = signals[known] @ signals[: 1 + c + h].T
    product = products_with_lags(signals, step, behind)

    ends = step[:, n_samples - 1 : n_samples + behind - 1].T[::-1]  # what leaves the sum with every further lag
    between = np.zeros((behind, behind, c, c))
    if behind:
        between[0] = product[:, own]
    for i in range(1, behind):
        between[i, i:] = between[i - 1, i - 1 : -1] - ends[i - 1, None, :, None] * ends[i - 1 : -1, None, :]
    later, earlier = np.tril_indices(behind, -1)
    between[later, earlier] = between[earlier, later].swapaxes(-1, -2)

    blocks, rows, sums = np.zeros((c, taps, c, taps)), np.zeros((c, taps, h)), np.zeros((c, taps))
    blocks[:, 0, :, 0], blocks[:, 1:, :, 1:] = level[1:, known][:, 1:], between.transpose(2, 0, 3, 1)
    blocks[:, 0, :, 1:] = product[:, 1 : 1 + c].transpose(1, 2, 0)
    blocks[:, 1:, :, 0] = product[:, 1 : 1 + c].transpose(2, 0, 1)
    sums[:, 0], sums[:, 1:] = level[0, 1 : 1 + c], product[:, 0].T
    rows[:, 0], rows[:, 1:] = level[1:, state], product[:, state].transpose(2, 0, 1)
    gram = np.block(
        [[np.full((1, 1), n_samples), sums.reshape(1, -1)], [sums.reshape(-1, 1), blocks.reshape(c * taps, -1)]]
    )
    cross = np.concatenate([level[:1, state], rows.reshape(-1, h)])
    return gram / n_samples, cross / n_samples, np.mean(truth**2, axis=0)


def products_with_lags(signals: Array, step: Array, behind: int) -> Array:
    """Return ``sum_k signals[:, k] step[:, behind - j + k]`` for lags j = 1, ..., behind, shape (behind, s, c); signals (s, n_samples)."""
    if not behind:
        return np.zeros((0, len(signals), len(step)))
    size = 1 << (8 * behind).bit_length()
    piece = size - behind
    count = -(-signals.shape[1] // piece)
    first = np.pad(signals, ((0, 0), (0, count * piece - signals.shape[1]))).reshape(len(signals), count, piece)
    padded = np.pad(step, ((0, 0), (0, count * piece + behind - step.shape[1])))
    second = np.lib.stride_tricks.sliding_window_view(padded, size, axis=1)[:, ::piece]
    common = np.einsum("spf,cpf->scf", np.fft.rfft(first, size), np.fft.rfft(second).conj(), optimize=True).conj()
    found = np.moveaxis(np.fft.irfft(common, size)[..., :behind], -1, 0)[::-1]
    moved = (step != 0).argmax(axis=1) + np.arange(1, behind + 1)[:, None] < step.shape[1]
    return np.where(moved[:, None], found, 0.0)
