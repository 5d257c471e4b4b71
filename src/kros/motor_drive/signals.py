r"""Loads as signals: what a mounted load asks of a machine, and which part of a load a position measurement shows.

A drive under integral control stands at its target whatever it carries. The torque tau_0 that it holds at the start
leaves no trace in positions and targets: tau and tau - tau_0 look the same. What can be seen is the change since the
start, and with a leak, which keeps estimates from drifting, its high-passed part

.. math:: \tau_s(k) = p\,\tau_s(k-1) + \tau(k) - \tau(k-1), \qquad \tau_s(0) = 0, \quad p = e^{-T/T_\ell},

with the time T_l after which a constant load is forgotten.

*The paper's estimate* (section IV-E.2) is the current's error of an observer of the unloaded machine under load,
``tau = K (i - i_hat)``. An observer that knows the current under load hides the load.

The level of a load that is fixed to an angle, and drives at their current limit.

What is seen of a load lacks its level (`without_level`). A mass mounted off the axis takes ``tau = c_1 sin(theta) + c_2
cos(theta)`` plus what is fast. The same filter makes ``psi = H phi`` of ``phi = [sin(theta), cos(theta)]``, so that the
seen part gives c by least squares as soon as the machine turns,

.. math:: \hat c_k = \Bigl(\sum_j \psi_j \psi_j^T T + \epsilon I\Bigr)^{-1} \sum_j \psi_j \hat\tau_s(j) T, \qquad
          \hat\tau = \hat\tau_s + (\varphi - \psi)^T \hat c .

A controller at its limit holds its integrator back. Where the total current comes out beyond the limit, the excess is
taken off the load, and forgotten as slowly as levels are. If that would move the load by more than `trusted` from what
c says of the angle, it is no load: changes are counted again from there, and what excess remains is taken off what the
unloaded machine needs.

The load as one more hidden state: an estimator made from recordings of a few units under a known load.

The load is the last state: zero in recordings without load, known in the others. Both kinds count alike, however many
there are. The estimator is regressed on the part that can be seen (`without_level`) of the load and, since under load
the level is missing there too, of the current:

.. math:: \tau_s, \qquad i - (\tau - \tau_s).

Its bank has one lag with the same forgetting: the integral of the tracking error, which the drive's controller holds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..core import Array, ArrayLike, ConfigError, DataError, DimensionError
from ..data import EpisodeBatch, EpisodeKey
from ..lifting import Lifting
from ..observer import EstimatorSettings, Observer, Recordings, identify_estimator


def low_passed(signal: ArrayLike, corner_hz: float, sample_period_s: float) -> Array:
    """Return signals below a corner without delay: Butterworth of order four, forward and backward."""
    from scipy.signal import butter, sosfiltfilt

    top = 0.5 / sample_period_s
    if not 0 < corner_hz < top:
        raise ConfigError(f"Low-pass at {corner_hz:g} Hz: the corner should lie between 0 and {top:g} Hz.")
    sections = butter(4, corner_hz, fs=1 / sample_period_s, output="sos")
    return sosfiltfilt(sections, np.asarray(signal, dtype=float), axis=0)


def without_level(signal: ArrayLike, level_s: float, sample_period_s: float) -> Array:
    """Return the part of signals that can be seen: their change since the start, forgotten after `level_s`."""
    from scipy.signal import lfilter

    signal, pole = np.asarray(signal, dtype=float), float(np.exp(-sample_period_s / level_s))
    return lfilter([1.0, -1.0], [1.0, -pole], signal - signal[:1], axis=0)


def known_load(
    position: ArrayLike,
    sample_period_s: float,
    moment: float,
    inertia: float = 0.0,
    corner_hz: float = 20.0,
) -> Array:
    """Return the torque of a mounted mass, ``moment sin(position) + inertia position''``, position in rad."""
    position = np.asarray(position, dtype=float)
    load = moment * np.sin(position)
    if inertia:
        acceleration = np.zeros_like(position)
        acceleration[1:-1] = np.diff(position, n=2, axis=0) / sample_period_s**2
        load = load + inertia * low_passed(acceleration, corner_hz, sample_period_s)
    return np.asarray(load, dtype=float)


@dataclass(frozen=True)
class LoadAccuracy:
    """Errors of a load estimate, low-passed, in units of the load."""

    floor_rms: float  # Of the estimate on episodes without load
    error_rms: float  # Under load
    load_rms: float  # Of the load itself

    @property
    def ratio(self) -> float:
        """Error under load to the floor."""
        return self.error_rms / self.floor_rms

    @property
    def percent(self) -> float:
        """Error under load in percent of the load."""
        return 100 * self.error_rms / self.load_rms


def load_accuracy(
    estimate: ArrayLike, load: ArrayLike, sample_period_s: float, corner_hz: float = 5.0, skip: int = 0
) -> LoadAccuracy:
    """Judge estimates of the load, shape (n_samples, batch), against known ones."""
    truth = np.asarray(load, dtype=float)
    loaded = np.any(truth != 0, axis=0)
    if loaded.all() or not loaded.any():
        count = f"{int(loaded.sum())} of {len(loaded)}"
        raise DataError(f"Load accuracy: needs episodes with and without load, found {count} with load.")
    slow = low_passed(truth, corner_hz, sample_period_s)[skip:]
    error = low_passed(estimate, corner_hz, sample_period_s)[skip:] - slow
    signals = error[:, ~loaded], error[:, loaded], slow[:, loaded]
    return LoadAccuracy(*(float(np.sqrt(np.mean(signal**2))) for signal in signals))


@dataclass(frozen=True)
class TorqueScale:
    """Torque of a current's error."""

    torque_constant: float  # torque per unit of current
    bias: float  # error of the current without load, in units of current

    @classmethod
    def calibrated(
        cls, error: ArrayLike, known: ArrayLike, sample_period_s: float, corner_hz: float = 5.0, skip: int = 300
    ) -> TorqueScale:
        """Return the scale from the error of a current and a known load by least squares of low-passed signals."""
        x, t = (low_passed(s, corner_hz, sample_period_s)[skip:].ravel() for s in (error, known))
        covariance = np.cov(x, t)
        if not covariance[0, 1] > 0:
            found = f"deviations {t.std():.3g} and {x.std():.3g} and covariance {covariance[0, 1]:.3g}"
            raise DataError(f"Torque constant: the current's error should follow the load, found {found}; check signs.")
        constant = float(covariance[0, 1] / covariance[0, 0])
        return cls(constant, float(x.mean() - t.mean() / constant))

    def load(self, error: ArrayLike) -> Array:
        """Return the load's torque, ``K (i - i_hat - bias)``, from measured minus estimated current."""
        return self.torque_constant * (np.asarray(error, dtype=float) - self.bias)


class LoadAndCurrent(NamedTuple):
    """Load and total current with their levels, both of one shape and in the current's unit."""

    load: Array
    current: Array


@dataclass(frozen=True)
class AngleLoad:
    """Fill in the level of loads that are fixed to an angle.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.motor_drive import AngleLoad
    >>> position = np.linspace(0.0, 3.0, 3000)[:, None]
    >>> seen = 0.2 * np.sin(position)  # sample, episode
    >>> AngleLoad(level_s=100.0, sample_period_s=0.001).run(seen, seen, position).load.shape
    (3000, 1)
    """

    level_s: float  # s; of the load observer (`LoadSettings`)
    sample_period_s: float
    settling_s: float = 0.1  # s; time at full swing (sin^2 of one half) after which half of c is used
    limit: float = np.inf  # of the current
    trusted: float = 0.5  # most that a load at the limit differs from what the angle says, as a share of the limit

    def run(self, seen: ArrayLike, current: ArrayLike, position: ArrayLike) -> LoadAndCurrent:
        """Return loads and currents with their levels, for signals of shape (n_samples, batch).

        `seen` and `current` are the observer's load and current in the current's unit, `position` is measured in rad;
        where it is NaN the last angle stands for it.
        """
        seen, current, position = (np.asarray(x, dtype=float) for x in (seen, current, position))
        if seen.ndim != 2 or not seen.shape == current.shape == position.shape:
            raise DimensionError(
                f"Level of a load: seen part {seen.shape}, current {current.shape} and position {position.shape} "
                f"should all be (n_samples, batch)."
            )
        rows = list(self._running(seen, current, position))
        return LoadAndCurrent(*(np.stack(column) for column in zip(*rows, strict=True)))

    def _running(self, seen: Array, current: Array, position: Array) -> Iterator[tuple[Array, Array]]:
        """Yield load and total current sample by sample, from the observer's and the measured angles in rad."""
        limit, pole = self.limit, self.pole
        before = np.stack([np.sin(position[0]), np.cos(position[0])])
        psi, right = np.zeros_like(before), np.zeros_like(before)
        excess, need = np.zeros((2, *position[0].shape))  # taken off the load, and off the unloaded current
        gram = 0.5 * self.settling_s * np.eye(2)[:, :, None] * np.ones_like(position[0])
        for tau, i, angle in zip(seen, current, position, strict=True):
            phi = np.stack([np.sin(angle), np.cos(angle)])
            phi = np.where(np.isnan(phi), before, phi)
            psi = pole * psi + np.nan_to_num(phi - before)
            before, excess, need = phi, pole * excess, pole * need
            coefficients = np.linalg.solve(gram.transpose(2, 0, 1), right.T[..., None])[..., 0].T
            of_angle = np.sum(np.nan_to_num(phi) * coefficients, axis=0)  # zero where no angle has arrived yet
            load = tau - excess + of_angle - np.sum(psi * coefficients, axis=0)
            total = i - tau - need + load
            bounded = np.clip(total, -limit, limit)
            beyond = bounded != total
            if beyond.any():
                shifted = load - (total - bounded)
                trusted = beyond & (np.abs(shifted - of_angle) <= self.trusted * limit)
                anew = beyond & ~trusted
                excess[trusted] += (total - bounded)[trusted]
                load[trusted] = shifted[trusted]
                psi[:, anew], excess[anew], load[anew] = 0.0, tau[anew], of_angle[anew]
                total[anew] = (i - tau - need + load)[anew]
                bounded[anew] = np.clip(total[anew], -limit, limit)
                need[anew] += (total - bounded)[anew]
            learns = np.where(beyond, 0.0, self.sample_period_s)
            gram = gram + learns * psi[:, None] * psi
            right = right + learns * psi * (tau - excess)
            yield load, bounded

    @property
    def pole(self) -> float:
        """What of a level is left after a sample."""
        return float(np.exp(-self.sample_period_s / self.level_s))


LOAD = "load"


@dataclass(frozen=True)
class LoadSettings:
    """How a known load is read."""

    current: int | None = None  # state that carries the load, in the load's unit; None where none does
    level_s: float = 10.0  # s; time after which a constant load is forgotten
    corner_hz: float | None = None  # what is faster in the known load, such as vibrations of the gear, is no load
    limit: float = np.inf  # of the current; episodes that reach it are left out
    delays: int = 20  # of the estimator, in samples: few recordings have a known load
    start_trust: float = 1e-4  # of the estimator; the load of the first sample is in its tracking error


def load_observer(
    name: str,
    lifting: Lifting,
    measured: Sequence[int],
    inputs: Sequence[str],
    batch: EpisodeBatch,
    load: Array,
    settings: LoadSettings | None = None,
) -> tuple[Observer, tuple[int, ...]]:
    """Return the estimator of the recorded states and ``load``, and the episodes whose current reaches its limit.

    The functions of the lifting read measured states alone, and so does it at run time. `load`, (n_samples, batch), is
    zero in recordings without load; the estimated one and, under load, the current lack their level (`AngleLoad`).
    """
    settings = settings or LoadSettings()
    if batch.states.shape[:2] != load.shape or LOAD in lifting.states:
        raise DimensionError(
            f"Load observer: states {batch.states.shape} and load {load.shape} should agree in (n_samples, batch), "
            f"and no state be named {LOAD!r}, found {', '.join(lifting.states)}."
        )
    at_limit = np.zeros(len(batch.keys), bool)  # where the controller does not do what its errors say
    if settings.current is not None:
        at_limit = np.abs(batch.states[..., settings.current]).max(axis=0) >= settings.limit
    used = np.flatnonzero(~at_limit)
    visible = _visible(batch.take(used.tolist()), load[:, used], int(at_limit.sum()), settings)
    place = {key: i for i, key in enumerate(visible.keys)}
    lengths = visible.lengths
    recordings = Recordings.of(visible.keys, lambda k: visible.take([place[k]]).head(int(lengths[place[k]])))
    lag = settings.level_s / batch.sample_period_s
    bank = {"dense": settings.delays, "longest": settings.delays}
    lags = {"first_lag": lag, "last_lag": lag / recordings.length, "start_trust": (settings.start_trust,)}
    estimator = EstimatorSettings(**bank, **lags)
    with_load = replace(lifting, states=(*lifting.states, LOAD))
    result = identify_estimator(
        name, with_load, tuple(measured), inputs, recordings, batch.sample_period_s, None, estimator
    )
    return result.observer, tuple(np.flatnonzero(at_limit).tolist())


def _visible(batch: EpisodeBatch, load: Array, left_out: int, settings: LoadSettings) -> EpisodeBatch:
    """Recordings with the load as a state, both as far as they can be seen; the conditions are "loaded" and not."""
    loaded = np.any(load != 0, axis=0)
    if not loaded.any() or loaded.all():
        raise DataError(
            f"Load observer: needs recordings with and without load, found {int(loaded.sum())} and "
            f"{int((~loaded).sum())}; {left_out} come to the current's limit; take a smaller load or slower moves."
        )
    dt = batch.sample_period_s
    torque = load if settings.corner_hz is None else low_passed(load, settings.corner_hz, dt)
    seen = without_level(torque, settings.level_s, dt)
    states = np.concatenate([batch.states, seen[..., None]], axis=-1)
    if settings.current is not None:
        states[..., settings.current] -= load - without_level(load, settings.level_s, dt)
    # Keys of one unit: units with a known load are too few to leave one out.
    keys = tuple(EpisodeKey("", "loaded" if on else "unloaded", str(i)) for i, on in enumerate(loaded))
    return replace(batch, keys=keys, states=states, shown=None, lost=None)
