r"""The bank: delays and first-order lags of channels, and the decaying values of the first sample.

For a channel v the bank holds

.. math:: v_k, \quad v_{k-i} - v_{k-i-1}, \quad l_k = a l_{k-1} + (1 - a) v_k, \quad a = e^{-1/\tau},

and for the start :math:`e^{-k/\tau} [1, v_0]`. A resonance is a lag with a complex time constant, real and imaginary
part. Before the first sample everything is taken to equal it. As a system, :math:`\xi_k = A \xi_{k-1} + B v_k`,
:math:`\xi_{-1} = S v_0` (v ends with the constant channel 1), it is stable.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np

from ...core import ITERATED, Array, Whole, frozen
from .channels import Channels
from .settings import EstimatorSettings

_BLOCK, _ROWS = 32, 64  # samples of a block, and rows at a time: few, so that they stay in the cache


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
        return len(self.entries)

    @cached_property
    def entries(self) -> list[tuple[str, complex, int]]:
        """Filter with its delay or time constant, and channel of every entry; the constant channel is the last, -1."""
        moving, delayed, every = range(self.channels - 1), range(self.delayed), (*range(self.channels - 1), -1)
        filters: list[tuple[str, complex, Iterable[int]]] = [("value", 0, moving)]
        filters += [("step", i, delayed) for i in range(1, self.delays)]
        filters += [("lag", tau, moving) for tau in self.lags]
        filters += [(part, tau, moving) for part in ("real", "imaginary") for tau in self.resonances]
        filters += [("start", tau, every) for tau in self.starts]
        return [(kind, tau, channel) for kind, tau, channels in (*filters, ("value", 0, (-1,))) for channel in channels]

    @property
    def channel(self) -> Whole:
        """Channel of every entry, shape (len(self),)."""
        return np.array([channel for *_, channel in self.entries])

    def places(self, part: Bank) -> Whole:
        """Return where the entries of a part of this bank are, one with fewer filters or of fewer channels."""
        places = {entry: place for place, entry in enumerate(self.entries)}
        return np.array([places[entry] for entry in part.entries])

    def rows(self, v: Array, at: Whole) -> Array:
        """Return the bank at samples `at` of signals v (n_samples, channels), shape (len(at), len(self))."""
        filters = self.filtered(v, at)
        return np.hstack([v[at, :-1], self.steps(v, at), *filters, self.started(v[0], at), np.ones((len(at), 1))])

    def steps(self, v: Array, at: Whole) -> Array:
        """Return the changes from sample to sample before samples `at`, the last one first."""
        changes = np.concatenate([np.zeros((self.delays, self.delayed)), np.diff(v[:, : self.delayed], axis=0)])
        windows = np.lib.stride_tricks.sliding_window_view(changes[::-1].ravel(), (self.delays - 1) * self.delayed)
        return windows[(len(v) - 1 - at) * self.delayed]

    def filtered(self, v: Array, at: Whole) -> list[Array]:
        """Return lags and the real and imaginary parts of resonances at samples `at`."""
        lags, resonances = (
            lagged(v[:, :-1], np.exp(-1 / np.array(taus)), at) if taus else np.zeros((len(at), 0))
            for taus in (self.lags, self.resonances)
        )
        return [lags, resonances.real, resonances.imag]

    def started(self, first: Array, at: Whole) -> Array:
        """Return the entries of a first sample (channels,), or one for each row, at samples `at`."""
        decays = np.exp(-at[:, None] / np.array(self.starts))
        return (decays[..., None] * np.expand_dims(first, -2)).reshape(len(at), -1)

    def restarted(self, v: Array, first: Array, begin: Whole, at: Whole) -> Array:
        """Return by how much rows at samples `at` change where signals v start at samples `begin`, not after them.

        The signals are then `first` (len(at), channels) at these samples, and before.
        """
        count, moving, delay, age = len(at), self.channels - 1, np.arange(self.delays - 1), (at - begin)[:, None]
        other = (first - v[begin])[:, :-1]
        steps = np.where((delay >= age)[..., None], -self.steps(v, at).reshape(count, len(delay), self.delayed), 0.0)
        steps -= (delay == age - 1)[..., None] * other[:, None, : self.delayed]
        lags, real, imaginary = self.filtered(v, begin)
        changes = []
        for taus, past in ((self.lags, lags), (self.resonances, real + 1j * imaginary)):
            gone = np.exp(-age / np.array(taus))[..., None]
            changes.append((gone * (first[:, None, :-1] - past.reshape(count, len(taus), moving))).reshape(count, -1))
        values, constant = np.where(age == 0, other, 0.0), np.zeros((count, 1))
        starts = self.started(first, age[:, 0]) - self.started(v[0], at)
        return np.hstack(
            [values, steps.reshape(count, -1), changes[0], changes[1].real, changes[1].imag, starts, constant]
        )

    def sizes(self, rms: Array) -> Array:
        """Return the sizes of entries, their RMS; for the start of its decay by the channel's: many start at rest."""
        size, first, of_channel = rms.copy(), self.first, np.append(rms[: self.channels - 1], 1.0)
        size[first] = np.outer(rms[first][self.channels - 1 :: self.channels], of_channel).ravel()
        return np.maximum(size, ITERATED * np.where(of_channel, of_channel, 1.0)[self.channel])

    @property
    def first(self) -> slice:
        """Entries of the first sample."""
        return slice(-1 - len(self.starts) * self.channels, -1)

    def system(self) -> tuple[Array, Array, Array]:
        """Return A (p, p), B (p, channels) and S (p, channels)."""
        size, place = len(self), {entry: i for i, entry in enumerate(self.entries)}
        A, B, S = np.zeros((size, size)), np.zeros((size, self.channels)), np.zeros((size, self.channels))
        for i, (kind, tau, channel) in enumerate(self.entries):
            a = np.exp(-1 / tau) if tau else 0.0
            match kind:
                case "value" | "lag":
                    A[i, i], B[i, channel], S[i, channel] = a, 1 - a, 1.0
                case "real":
                    A[i, i], A[i, place["imaginary", tau, channel]] = a.real, -a.imag
                    B[i, channel], S[i, channel] = 1 - a.real, 1.0
                case "imaginary":
                    A[i, i], A[i, place["real", tau, channel]], B[i, channel] = a.real, a.imag, -a.imag
                case "start":
                    A[i, i], S[i, channel] = a, 1 / a
                case _ if tau == 1:  # the last step
                    A[i, place["value", 0, channel]], B[i, channel] = -1.0, 1.0
                case _:
                    A[i, place["step", tau - 1, channel]] = 1.0
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
