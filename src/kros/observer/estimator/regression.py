r"""Ridge regression of all states on the bank, its penalty chosen on units and episodes that are left out.

Rows :math:`\xi_k` of the bank, divided by their sizes, have principal directions and singular values
:math:`\sigma_i`. In whitened directions the penalty of the bank's own coefficients is :math:`\lambda / \sigma_i^2`.
Rows with target zero say how far an entry may be wrong. Moments of units, conditions and parts of the episodes are
summed once; leaving some out is a difference of moments. Units often follow the same references: errors are those of
coefficients that know neither the unit nor its episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import compress, product
from typing import TypeVar

import numpy as np

from ...core import EPS, ROUNDING, AnyArray, Array, DataError, Flags, Whole, frozen
from ...core.linalg import qr_triangle
from ...data import EpisodeBatch, EpisodeKey
from .bank import Bank
from .channels import Channels
from .settings import EstimatorSettings

T = TypeVar("T", bound=Hashable)
Read = Callable[[EpisodeKey], EpisodeBatch]
Rows = tuple[EpisodeKey, Array, Array, Array]  # rows of the bank, targets and weights
Shown = Callable[[Array], Array]  # from measurements (n_samples, q) to what the bank sees of them
_SMALLEST = 5e4 * EPS  # of singular values: what is smaller is rounding


@dataclass(frozen=True)
class Group:
    """Episodes whose moments are summed: a part of those of a fold of units in a condition."""

    fold: int
    condition: str
    part: int


@frozen
class Recordings:
    """Training episodes, read one by one.

    Parameters
    ----------
    keys : tuple of EpisodeKey
    lengths : tuple of int
        Samples of every episode.
    read : callable
        Returns the `EpisodeBatch` of one key.
    size : ndarray, shape (n,)
        Sizes of the recorded states.
    ranges : tuple of ndarray, shape (n + m,)
        Least and largest values of states and inputs.
    bias : ndarray, optional
        Offsets of the measured states that their sensors may have at run time, of either sign, shape (q,).

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.observer import Recordings
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> recordings = Recordings.of(list(motors.keys()), lambda key: EpisodeBatch.read(motors, [key]))
    >>> len(recordings.keys), recordings.size.shape
    (4, (3,))
    """

    keys: tuple[EpisodeKey, ...]
    lengths: tuple[int, ...]
    read: Read
    size: Array
    ranges: tuple[Array, Array]
    bias: Array | None = None

    @classmethod
    def of(cls, keys: Sequence[EpisodeKey], read: Read, bias: Array | None = None) -> Recordings:
        """Return the episodes with their lengths and the sizes of their states."""
        extents, n = [], 0
        for batch in map(read, keys):
            values, n = np.concatenate([batch.states, batch.inputs], axis=-1)[:, 0], batch.states.shape[-1]
            extents.append((len(values), values.min(axis=0), values.max(axis=0)))
        lengths, lows, highs = zip(*extents, strict=True)
        low, high = np.min(lows, axis=0), np.max(highs, axis=0)
        size = np.maximum(np.abs(low), np.abs(high))[:n]
        size[size == 0] = 1.0
        return cls(tuple(keys), lengths, read, size, (low, high), bias)

    @property
    def length(self) -> float:
        """Median length of an episode in samples."""
        return float(np.median(self.lengths))

    def some(self, count: int, groups: Mapping[EpisodeKey, Group] | None = None) -> Recordings:
        """Return some episodes, spread over all or over those of every group, and one of each at least."""
        members: dict[Group | None, list[EpisodeKey]] = {}
        for key in self.keys:
            members.setdefault((groups or {}).get(key), []).append(key)
        share = min(1.0, count / len(self.keys))
        kept = {key for keys in members.values() for key in spread(keys, max(1, round(share * len(keys))))}
        return self.only([key in kept for key in self.keys])

    def only(self, which: Sequence[bool]) -> Recordings:
        """Return the episodes that are flagged."""
        return replace(self, keys=tuple(compress(self.keys, which)), lengths=tuple(compress(self.lengths, which)))


def thinned(lengths: Sequence[int], rows: int, first: int) -> Iterator[tuple[Whole, Array]]:
    """Yield which samples of every episode are about so many rows, and for how many each stands.

    Each has a sample after it. At the start they are denser than later.
    """
    first = min(first, min(lengths) - 1)
    early = max(1, -(-3 * len(lengths) * first // rows))
    late = max(1, -(-sum(lengths) // max(1, rows - len(lengths) * (first // early))))
    for number, length in enumerate(lengths):
        parts = np.arange(number % early, first, early), np.arange(first + number % late, length - 1, late)
        yield np.concatenate(parts), np.repeat([float(early), float(late)], [len(part) for part in parts])


def interpolated(y: Array) -> Array:
    """Return measurements (n_samples, q) with straight lines over those that are missing."""
    if np.isfinite(y).all():
        return y
    filled = y.copy()
    for column in filled.T:
        there = np.isfinite(column)
        if not there.any():
            raise DataError("Estimator: no sample of a measurement arrives in a training episode; leave it out.")
        column[~there] = np.interp(np.flatnonzero(~there), np.flatnonzero(there), column[there])
    return filled


def bridged(y: Array) -> Array:
    """Return measurements (n_samples, q) with straight lines over half of the samples, lost at random."""
    lost = np.random.default_rng(0).random(len(y)) < 0.5
    return interpolated(np.where(lost[:, None], np.nan, y))


@frozen
class Design:
    """A bank of channels with the recordings that it is fitted to: the rows of the regression."""

    channels: Channels
    bank: Bank
    recordings: Recordings
    settings: EstimatorSettings
    shown: Shown = interpolated
    late: bool = False  # whether rows are of samples after a random one of every episode
    fresh: bool = True  # whether the bank starts there, too

    @classmethod
    def of(
        cls, channels: Channels, recordings: Recordings, settings: EstimatorSettings, poles: Sequence[complex] = ()
    ) -> Design:
        """Return the design with the bank of its channels, and of poles of the machines."""
        return cls(channels, Bank.of(channels, recordings.length, settings, poles), recordings, settings)

    def rows(self, recordings: Recordings, rows: int) -> Iterator[Rows]:
        """Yield episode, bank rows, targets and weights of every episode, with measurements as they are shown.

        Targets are states at the next sample, of measured ones their distance from the reference of the channels.
        """
        first = round(self.settings.start_rows * max(self.settings.start, default=0.0))
        samples = thinned(recordings.lengths, rows, first)
        measured, rng = list(self.channels.measured), np.random.default_rng(self.settings.seed)
        for key, (at, weights) in zip(recordings.keys, samples, strict=True):
            states, y, v = self.episode(recordings.read(key))
            begin = int(rng.integers(0, len(v) // 2)) if self.late else 0
            after = np.minimum(at, len(v) - begin - 2)
            at = begin + after
            seen = self.bank.rows(self.channels.filtered(v[begin:] if self.fresh else v), after if self.fresh else at)
            targets = states[at + 1] / recordings.size
            reference = v[at] @ self.channels.reference.T
            reference[:, self.channels.held] = y[at][:, self.channels.held]
            targets[:, measured] -= reference / recordings.size[measured]
            yield key, seen, targets, weights

    def episode(self, batch: EpisodeBatch) -> tuple[Array, Array, Array]:
        """Return states, measurements as they are shown, and channels of an episode, (n_samples, .)."""
        length, own = batch.lengths[0], {k: p[0] for k, p in batch.parameters.items()}
        y = self.shown(batch.measurements(self.channels.measured)[:length, 0])
        return batch.states[:length, 0], y, self.channels.signals(y, batch.inputs[:length, 0], own)

    def signals(self, some: int, length: int) -> Array:
        """Return what filters see in some episodes, cut to one length, shape (n_samples, batch, channels)."""
        recordings = self.recordings.some(some)
        shortest = min(length, *recordings.lengths)
        channels = (self.episode(batch)[2] for batch in map(recordings.read, recordings.keys))
        return np.stack([self.channels.filtered(v)[:shortest] for v in channels], axis=1)

    @cached_property
    def groups(self) -> dict[EpisodeKey, Group]:
        """The group of every episode: those of one name are in one part, and a unit is in one fold."""
        keys, folds, parts = self.recordings.keys, self.settings.folds, self.settings.parts
        names, units = (sorted(set(column)) for column in zip(*((k.episode, k.unit) for k in keys), strict=True))
        return {k: Group(units.index(k.unit) % folds, k.condition, names.index(k.episode) % parts) for k in keys}

    @property
    def errors(self) -> list[tuple[float, Design, Design]]:
        """Errors that rows may have: their weights, designs that see them, and the same without."""
        bias, seen = self.recordings.bias, list[tuple[float, Shown]]()
        if not self.channels.inputs_only:
            seen.append((self.settings.gap_share, bridged))
        if bias is not None and bias.any():  # an offset of either sign adds its own moment to the errors
            seen.append((1.0, lambda y: interpolated(y) + bias))
        errors = [(share, replace(self, shown=shown), self) for share, shown in seen]
        late = replace(self, late=True)
        return [*errors, (1.0, late, replace(late, fresh=False))]

    @property
    def fine(self) -> Design:
        """The design of the bank with every delay."""
        return replace(self, bank=self.bank.fine)


def in_step(designs: Sequence[Design], recordings: Recordings, rows: int) -> Iterator[tuple[Rows, ...]]:
    """Yield what `Design.rows` yields of several designs, episode by episode: each is read once."""
    once = replace(recordings, read=lru_cache(maxsize=1)(recordings.read))
    return zip(*(design.rows(once, rows) for design in designs), strict=True)


def samples(designs: Sequence[Design]) -> list[tuple[Array, Array]]:
    """Return thinned rows of the bank of every design, and weights that sum to one."""
    recordings, settings = designs[0].recordings, designs[0].settings
    parts, weights = [list[Array]() for _ in designs], list[Array]()
    for episode in in_step(designs, recordings.some(settings.episodes // 2), settings.sample):
        weights.append(episode[0][-1])
        for of_one, (_, rows, *_) in zip(parts, episode, strict=True):
            of_one.append(rows)
    weight = np.concatenate(weights)
    return [(np.vstack(parts.pop(0)), weight / weight.sum()) for _ in designs]  # one design after the other: memory


@frozen
class Whitening:
    """Principal directions of the bank."""

    sample: tuple[Array, Array]  # thinned rows, from which they are found, with their weights
    directions: Array  # (p, r)
    penalty: Array  # (r,), 1 / sigma^2
    trust: Array  # (r, r), moments of the rows that say how far entries may be wrong
    restart: Array  # (r, r), the same of starts in the middle of an episode

    @classmethod
    def of(cls, designs: Sequence[Design]) -> list[Whitening]:
        """Find the directions of every design, one design after the other: memory."""
        found = []
        for design in designs:
            errors = design.errors
            sample, *others = samples([design, *(one for _, *pair in errors for one in pair)])
            pairs = iter(others)
            wrong = [(share, next(pairs)[0] - next(pairs)[0]) for share, *_ in errors]
            found.append(cls._found(design, sample, wrong))
        return found

    @classmethod
    def _found(cls, design: Design, sample: tuple[Array, Array], errors: Sequence[tuple[float, Array]]) -> Whitening:
        """Find the directions from thinned rows, and what rows with errors of weights add."""
        X, weights = sample
        bank, settings = design.bank, design.settings
        size = bank.sizes(np.sqrt(weights @ (X * X)))
        scale = np.sqrt(weights)[:, None] / size
        trust = np.diag(bank.trust(settings.nonlinear_trust))
        for share, wrong in errors[:-1]:
            trust = np.vstack([trust, qr_triangle(wrong * scale * np.sqrt(share))])
        restart = qr_triangle(errors[-1][1] * scale)
        least = np.sqrt(settings.settled_share) * restart
        _, sigma, V = np.linalg.svd(qr_triangle(np.vstack([X * scale, trust, least])))
        count = int(np.sum(sigma > _SMALLEST * sigma[0]))
        directions = V[:count].T / sigma[:count] / size[:, None]
        moments = (rows.T @ rows for rows in (each @ (directions * size[:, None]) for each in (trust, restart)))
        return cls(sample, directions, sigma[:count] ** -2.0, *moments)


@frozen
class Moments:
    """Second moments of every group in whitened directions."""

    whitening: Whitening
    groups: tuple[Group, ...]
    gram: Array  # (groups, r, r)
    cross: Array  # (groups, r, n)
    power: Array  # (groups, n)
    rows: Array  # (groups,), how many there are

    @classmethod
    def of(cls, designs: Sequence[Design], whitenings: Sequence[Whitening]) -> list[Moments]:
        """Sum the rows of every group, for every design."""
        groups, settings = designs[0].groups, designs[0].settings
        sums: list[dict[Group, Array]] = [{} for _ in designs]
        for episode in in_step(designs, designs[0].recordings.some(settings.episodes, groups), settings.rows):
            for total, whitening, (key, rows, targets, weights) in zip(sums, whitenings, episode, strict=True):
                columns = np.hstack([rows @ whitening.directions, targets, np.ones((len(rows), 1))])
                columns *= np.sqrt(weights)[:, None]
                total[groups[key]] = total.get(groups[key], 0.0) + columns.T @ columns
        moments = []
        for whitening, total in zip(whitenings, sums, strict=True):
            r, mean = whitening.directions.shape[1], np.stack([*total.values()])
            count = mean[:, -1, -1].copy()
            mean /= count[:, None, None]
            power = np.diagonal(mean, axis1=1, axis2=2)[:, r:-1]
            moments.append(cls(whitening, tuple(total), mean[:, :r, :r], mean[:, :r, r:-1], power, count))
        return moments

    def of_groups(self, what: str) -> AnyArray:
        """Return fold, condition or part of every group."""
        return np.array([getattr(group, what) for group in self.groups])

    def errors(self, coefficients: Array, groups: slice = slice(None)) -> Array:
        """Return the mean squared errors of coefficients (r, n) in some groups, shape (groups, n)."""
        quadratic = np.einsum("in,gin->gn", coefficients, self.gram[groups] @ coefficients)
        found = self.power[groups] - 2 * np.einsum("in,gin->gn", coefficients, self.cross[groups]) + quadratic
        return np.maximum(found, 1e-30)

    def solved(self, weights: Array, candidates: Sequence[tuple[float, float]]) -> Iterator[Array]:
        """Yield ridge coefficients (r, n) of groups with weights, for every penalty and weight of restarts."""
        from scipy.linalg import cho_factor, cho_solve

        weights = weights / weights.sum()
        whitening = self.whitening
        gram = np.tensordot(weights, self.gram, 1) + whitening.trust
        cross = np.tensordot(weights, self.cross, 1)
        rounding = 16 * len(gram) * EPS
        for penalty, share in candidates:
            A = gram + share * whitening.restart + np.diag(penalty * whitening.penalty)
            q = 1 / np.sqrt(np.diag(A))
            scaled = A * q[:, None] * q + rounding * np.eye(len(q))
            yield q[:, None] * cho_solve(cho_factor(scaled, check_finite=False), q[:, None] * cross)

    def best(self, errors: Array, weights: int) -> list[Whole]:
        """Return the best candidates of every state for each of several weights of restarts, in turn the last index.

        They are best by logarithms of errors (groups, candidates, n) on what is left out.
        """
        # A state at zero throughout a group would ask for no estimate of it at all.
        counted = (self.power > 0)[:, None]
        mean = errors.mean(axis=0, where=counted | ~counted.any(axis=0))
        return [mean[i::weights].argmin(axis=0) * weights + i for i in range(weights)]

    def known(self, group: Group) -> Flags:
        """Return the groups without units and episodes of one; if none is left in its condition, without either."""
        alike = self.of_groups("condition") == group.condition
        folds, parts = self.of_groups("fold") != group.fold, self.of_groups("part") != group.part
        return next(known for known in (folds & parts, folds, parts, folds | True) if (known & alike).any())

    def without(self, weights: Array, candidates: Sequence[tuple[float, float]]) -> dict[Group, list[Array]]:
        """Return the coefficients that do not know a group, for every group and candidate."""
        known = {group: self.known(group) for group in self.groups}
        several = {rest.tobytes(): np.where(rest, weights, 0.0) for rest in known.values()}
        found = {key: list(self.solved(rest, candidates)) for key, rest in several.items()}
        return {group: found[rest.tobytes()] for group, rest in known.items()}


@frozen
class Readout:
    """Coefficients of all states on a bank, in the channels' units, with errors on units and episodes left out."""

    design: Design
    sample: tuple[Array, Array]  # thinned rows of the bank, with their weights
    coefficients: Array  # (p, n)
    begun: Array  # (p, n), with the weight of restarts for the time after a start
    left_out: Array  # (groups, n), mean squared errors over the squared sizes
    trained: Array  # (groups, n), of the coefficients that are returned
    penalties: Array  # (n, 2), and weights of restarts
    others: dict[Group, Array]  # coefficients (p, n) that do not know a group, over the sizes

    @classmethod
    def of(cls, designs: Sequence[Design]) -> list[Readout]:
        """Fit all states by every design, in two passes over the recordings."""
        return [cls._fitted(*each) for each in zip(designs, Moments.of(designs, Whitening.of(designs)), strict=True)]

    @classmethod
    def _fitted(cls, design: Design, moments: Moments) -> Readout:
        """Fit all states: conditions count inversely to their errors, penalties are best on what is left out."""
        whitening = moments.whitening
        weights, settings = condition_weights(moments), design.settings
        candidates = [*product(settings.penalties, (settings.settled_share, settings.restart_share))]
        others = moments.without(weights, candidates)
        left_out = [[moments.errors(c, slice(i, i + 1))[0] for c in others[g]] for i, g in enumerate(moments.groups)]
        errors = np.array(left_out)
        n, (best, first) = np.arange(errors.shape[2]), moments.best(np.log(errors), 2)
        every = np.array(list(moments.solved(weights, candidates)))
        coefficients, begun = (every[one, :, n].T for one in (best, first))
        return cls(
            design,
            whitening.sample,
            whitening.directions @ coefficients * design.recordings.size,
            whitening.directions @ begun * design.recordings.size,
            errors[:, best, n],
            moments.errors(coefficients),
            np.array(candidates)[best],
            {g: whitening.directions @ np.array(each)[best, :, n].T for g, each in others.items()},
        )

    def left_out_group(self) -> tuple[Group, Recordings]:
        """Return a group, and the recordings of its fold and part: what `without` it does not know."""
        groups, recordings = self.design.groups, self.design.recordings
        first = groups[recordings.keys[0]]
        same = [(groups[key].fold, groups[key].part) == (first.fold, first.part) for key in recordings.keys]
        return first, recordings.only(same)

    @property
    def typical(self) -> Array:
        """Typical left-out error of every state over its size, shape (n,)."""
        return np.exp(np.log(self.left_out).mean(axis=0) / 2)

    def without(self, group: Group) -> Readout:
        """Return the readout that does not know a group."""
        coefficients = self.others[group] * self.design.recordings.size
        return replace(self, coefficients=coefficients, begun=coefficients)

    def by_fold(self, states: Sequence[int]) -> Array:
        """Return the mean logarithm of the left-out mean squared errors of some states, shape (folds,)."""
        folds, errors = np.array([g.fold for g in self.others]), np.log(self.left_out[:, list(states)]).mean(axis=1)
        return np.array([errors[folds == fold].mean() for fold in np.unique(folds)])

    def episode_errors(self) -> Array:
        """Return the left-out mean squared errors of every episode over the squared sizes, shape (episodes, n)."""
        design, found = self.design, []
        for key, rows, targets, weights in design.rows(design.recordings, design.settings.rows):
            found.append(np.average((targets - rows @ self.others[design.groups[key]]) ** 2, axis=0, weights=weights))
        return np.array(found)


def spread(items: Sequence[T], count: int) -> list[T]:
    """Return so many items, evenly spaced from the first to the last."""
    return [items[i] for i in np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)]


def is_less(one: Array, other: Array, margin: float) -> bool:
    """Whether one is less than the other by so many paired standard errors."""
    difference = one - other
    error = difference.std(ddof=1) / np.sqrt(len(difference)) if len(difference) > 1 else 0.0
    return bool(difference.mean() + margin * error < 0)


def condition_weights(moments: Moments) -> Array:
    """Return weights of the groups: by rows within a condition, conditions inversely to the errors of a first fit."""
    conditions = moments.of_groups("condition")
    alike = conditions[:, None] == conditions
    (first,) = moments.solved(moments.rows, [(ROUNDING, 1.0)])
    errors = np.exp(np.log(moments.errors(first)).mean(axis=1))
    return moments.rows / (alike @ moments.rows) * alike.sum(axis=1) ** 2 / (alike @ errors)
