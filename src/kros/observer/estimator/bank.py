r"""The bank: delays and first-order lags of channels, and the decaying values of the first sample.

For a channel v the bank holds

.. math:: v_k, \quad v_{k-i} - v_{k-i-1}, \quad l_k = a l_{k-1} + (1 - a) v_k, \quad a = e^{-1/\tau},

and for the start :math:`e^{-k/\tau} [1, v_0]`. A resonance is a lag with a complex time constant, real and imaginary
part. Before the first sample everything is taken to equal it. As a system, :math:`\xi_k = A \xi_{k-1} + B v_k`,
:math:`\xi_{-1} = S v_0` (v ends with the constant channel 1), it is stable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core import ITERATED, Array, Whole, frozen
from .channels import Channels
from .settings import EstimatorSettings

_BLOCK, _ROWS = 32, 1000  # samples of a block, and rows at a time


@frozen
class Bank:
    """Filters of `channels` signals, the last of which is the constant one."""

    channels: int
    linear: int  # the first so many channels are linear in measurements and inputs
    memoryless: int  # so many channels before the constant have no delays
    delays: int  # samples
    lags: tuple[float, ...]  # samples
    starts: tuple[float, ...]  # samples
    resonances: tuple[complex, ...] = ()  # samples

    @classmethod
    def of(cls, channels: Channels, length: float, settings: EstimatorSettings, poles: Sequence[complex] = ()) -> Bank:
        """Return the bank for a median episode of this length in samples; complex poles become resonances."""
        lags = () if channels.recent else settings.lags(length)
        starts = () if channels.recent else (*settings.start, *lags)
        delays, slowest = settings.longest(length), np.exp(-1 / length)
        resonances = tuple(-1 / np.log(p * min(1.0, slowest / abs(p))) for p in poles if p.imag > 0)
        return cls(len(channels), channels.linear, channels.nonlinear, delays, lags, starts, resonances)

    @property
    def delayed(self) -> int:
        """Number of channels with delays, the first ones."""
        return self.channels - 1 - self.memoryless

    def __len__(self) -> int:
        return len(self.channel)

    @property
    def channel(self) -> Whole:
        """Channel of every entry, shape (len(self),)."""
        every, moving = np.arange(self.channels), np.arange(self.channels - 1)
        steps = [moving[: self.delayed]] * (self.delays - 1)
        lags = [moving] * (len(self.lags) + 2 * len(self.resonances))
        return np.concatenate([moving, *steps, *lags, *[every] * len(self.starts), every[-1:]])

    def rows(self, v: Array, at: Whole) -> Array:
        """Return the bank at samples `at` of signals v (n_samples, channels), shape (len(at), len(self))."""
        moving, past = v[:, :-1], v[:, : self.delayed]
        steps = np.concatenate([np.zeros((self.delays, self.delayed)), np.diff(past, axis=0)])
        parts = [moving[at], *(steps[at + self.delays - 1 - i] for i in range(self.delays - 1))]
        for lags in filter(None, (self.lags, self.resonances)):
            values = lagged(moving, np.exp(-1 / np.array(lags)), at)
            parts += [values.real, values.imag] if np.iscomplexobj(values) else [values]
        return np.hstack([*parts, self.started(v[0], at), np.ones((len(at), 1))])

    def started(self, first: Array, at: Whole) -> Array:
        """Return the entries of a first sample (channels,), or one for each row, at samples `at`."""
        decays = np.exp(-at[:, None] / np.array(self.starts))
        return (decays[..., None] * np.expand_dims(first, -2)).reshape(len(at), -1)

    def restarted(self, v: Array, first: Array, begin: Whole, at: Whole) -> Array:
        """Return by how much rows at samples `at` change where signals v start at samples `begin`, not after them.

        The signals are then `first` (len(at), channels) at these samples, and before.
        """
        past, now, age = self.rows(v, begin), self.rows(v, at), (at - begin)[:, None]
        count, moving, other = len(at), self.channels - 1, (first - v[begin])[:, :-1]
        filters = np.multiply(moving, [len(self.lags), len(self.resonances), len(self.resonances)])
        ends = np.cumsum([moving, (self.delays - 1) * self.delayed, *filters])
        _, _, lags, real, imaginary, _ = np.split(past, ends, axis=1)
        steps, delay = now[:, ends[0] : ends[1]], np.arange(self.delays - 1)
        steps = np.where((delay >= age)[..., None], -steps.reshape(count, len(delay), self.delayed), 0.0)
        steps -= (delay == age - 1)[..., None] * other[:, None, : self.delayed]
        parts = [np.where(age == 0, other, 0.0), steps.reshape(count, -1)]
        for tau, filtered in ((self.lags, lags), (self.resonances, real + 1j * imaginary)):
            gone = np.exp(-age / np.array(tau))[..., None]
            change = (gone * (first[:, None, :-1] - filtered.reshape(count, len(tau), moving))).reshape(count, -1)
            parts += [change.real, change.imag] if np.iscomplexobj(change) else [change]
        starts = self.started(first, age[:, 0]) - self.started(v[0], at)
        return np.hstack([*parts, starts, np.zeros((count, 1))])

    def sizes(self, rms: Array) -> Array:
        """Return the sizes of entries, their RMS; for the start of its decay by the channel's: many start at rest."""
        size, first, moving = rms.copy(), self.first, self.channels - 1
        size[first] = np.outer(rms[first][moving :: self.channels], [*rms[:moving], 1.0]).ravel()
        return np.maximum(size, ITERATED * size.max())

    def trust(self, nonlinear: float) -> Array:
        """Return the share of its size by which every entry may be wrong, shape (len(self),)."""
        channel = self.channel
        return np.where((channel >= self.linear) & (channel < self.channels - 1), nonlinear, 0.0)

    @property
    def first(self) -> slice:
        """Entries of the first sample."""
        return slice(-1 - len(self.starts) * self.channels, -1)

    def system(self) -> tuple[Array, Array, Array]:
        """Return A (p, p), B (p, channels) and S (p, channels)."""
        size, c, moving, delayed = len(self), self.channels, self.channels - 1, self.delayed
        A, B, S = np.zeros((size, size)), np.zeros((size, c)), np.zeros((size, c))
        B[range(moving), range(moving)] = S[range(moving), range(moving)] = 1.0
        place = moving
        for i in range(self.delays - 1):
            rows = np.arange(place, place + delayed)
            if i == 0:
                B[rows, range(delayed)], A[rows, range(delayed)] = 1.0, -1.0
            else:
                A[rows, rows - delayed] = 1.0
            place += delayed
        for tau in self.lags:
            rows, a = np.arange(place, place + moving), np.exp(-1 / tau)
            A[rows, rows], B[rows, range(moving)], S[rows, range(moving)] = a, 1 - a, 1.0
            place += moving
        for resonance in self.resonances:
            rows, p = np.arange(place, place + moving), np.exp(-1 / resonance)
            others = rows + len(self.resonances) * moving
            A[rows, rows], A[rows, others], A[others, rows], A[others, others] = p.real, -p.imag, p.imag, p.real
            B[rows, range(moving)], B[others, range(moving)], S[rows, range(moving)] = 1 - p.real, -p.imag, 1.0
            place += moving
        place += len(self.resonances) * moving
        for tau in self.starts:
            rows, a = np.arange(place, place + c), np.exp(-1 / tau)
            A[rows, rows], S[rows, range(c)] = a, 1 / a
            place += c
        B[-1, -1] = S[-1, -1] = 1.0
        return A, B, S


def lagged(v: Array, a: Array, at: Whole) -> Array:
    """Return ``h_k = a h_{k-1} + (1 - a) v_k``, ``h_{-1} = v_0``, at some samples, shape (len(at), a by channels).

    A recursion over blocks of samples, and sums within the block of every sample asked for.
    """
    from scipy.signal import lfilter

    count, channels = -(-len(v) // _BLOCK), v.shape[1]
    blocks = np.concatenate([v, np.repeat(v[-1:], count * _BLOCK - len(v), axis=0)]).reshape(count, _BLOCK, channels)
    age = np.subtract.outer(np.arange(_BLOCK), np.arange(_BLOCK))
    shares = ((1 - a) * a ** np.maximum(age, 0)[..., None] * (age >= 0)[..., None]).swapaxes(1, 2)  # to, lag, from
    sums, decay = shares[-1] @ blocks, a**_BLOCK
    ends = [lfilter([1], [1, -b], sums[:, i], axis=0, zi=b * v[:1])[0] for i, b in enumerate(decay)]
    before = np.concatenate([np.repeat(v[None, :1], len(a), axis=1), np.stack(ends, axis=1)])
    block, place = np.divmod(at, _BLOCK)
    gone = a ** (place + 1)[:, None]
    parts = [  # some rows at a time, for the sake of memory
        gone[some, :, None] * before[block[some]] + shares[place[some]] @ blocks[block[some]]
        for some in np.split(np.arange(len(at)), range(_ROWS, len(at), _ROWS))
    ]
    return np.concatenate(parts).reshape(len(at), -1)
