"""What a certificate says about recorded episodes: the residual that drove the error, the bounds that follow, and the error as it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...data import EpisodeBatch
from ...loops import recursion
from ..data import ObserverData
from ..residual.one_step import one_step_residual
from ..screen import screened
from ..simulate import run_observer
from .certificate import ReliftCertificate
from .error import ErrorSystem

Array = npt.NDArray[np.float64]
# Rounding: a predictor takes differences of positions a thousand times, and where slopes are constant the bound is the error itself.
_CLOSE = 1 + 1e-6


@dataclass(frozen=True)
class ReliftRow:
    """One episode. All values are root mean squares over its samples of the scaled signals, the states' squares added."""

    unit: str
    residual: float  # Of the one-step residual, divided by its size in the population
    gain_bound: float  # What ``gamma`` makes of it, the initial error included
    frozen: float  # Error that the residual would cause if every slope stayed in the middle of its interval
    bound: float  # The smaller of `gain_bound` and the frozen response plus what the movement of the slopes can add
    error: float  # Error of the observer as it ran

    @property
    def holds(self) -> bool:
        """Whether the error is within the bound; never false where the assumptions hold."""
        return self.error <= self.bound * _CLOSE

    def as_dict(self) -> dict[str, Any]:
        """Return it for a record."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def relift_report(
    certificate: ReliftCertificate,
    observer: ObserverData,
    batch: EpisodeBatch,
    estimates: Array | None = None,
    seen: Course | None = None,
) -> list[ReliftRow]:
    """Compare bounds and errors, episode by episode; recorded states stand for the true ones, so their noise is part of the residual."""
    if certificate.gain is None:
        raise DimensionError(
            f"Re-lift report of observer {observer.name}: it has no certificate ({certificate.reason}); certify it first."
        )
    seen, lengths, scales = seen or course(observer, batch, estimates), batch.lengths, certificate.scales
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.concatenate([seen.omega / scales.residual, seen.noise / scales.noise], axis=-1)
    w[np.isnan(w)] = 0.0  # what has no size has no part in the certificate
    inside = np.arange(len(seen.error))[:, None] < lengths
    z, q = frozen_response(certificate.system(observer), w, seen.first)
    energy = {
        "r": np.sum(np.where(inside[:-1, :, None], w[..., : observer.lifting.n_states], 0.0) ** 2, axis=(0, 2)),
        "w": np.sum(np.where(inside[:-1, :, None], w, 0.0) ** 2, axis=(0, 2)),
        "z": np.sum(np.where(inside[..., None], z, 0.0) ** 2, axis=(0, 2)),
        "q": np.sum(np.where(inside[..., None], q, 0.0) ** 2, axis=(0, 2)),
        "e": np.sum(np.where(inside[..., None], seen.error / scales.error, 0.0) ** 2, axis=(0, 2)),
    }
    by_gain = np.sqrt(certificate.gain**2 * energy["w"] + certificate.initial_energy(seen.first))
    by_frozen = np.sqrt(energy["z"]) + (
        certificate.mismatch_gain * np.sqrt(energy["q"]) if certificate.mismatch_gain is not None else np.inf
    )
    root = np.sqrt(lengths)
    by_frozen = np.where(np.isnan(by_frozen), np.inf, by_frozen)
    columns = (
        np.sqrt(energy["r"]),
        by_gain,
        np.sqrt(energy["z"]),
        np.minimum(by_gain, by_frozen),
        np.sqrt(energy["e"]),
    )
    return [ReliftRow(unit, *(float(c[i] / root[i]) for c in columns)) for i, unit in enumerate(batch.units)]


@dataclass(frozen=True, eq=False)
class Course:
    """What drove the error of an observer along recorded episodes, and the error."""

    omega: Array  # (n_samples - 1, batch, n): one-step residual; zero in internal states
    noise: Array  # (n_samples - 1, batch, q): what the sensor shows beside the recording, as it arrives
    first: Array  # (batch, n_window): first error, with the earlier ones that the lifting reads
    error: Array  # (n_samples, batch, n)
    lengths: npt.NDArray[np.int64]  # (batch,)
    inputs: Array  # recorded inputs, and the measurements as they arrive
    y: Array  # recorded inputs, and the measurements as they arrive
    beyond: Array  # (n_samples, batch, n_recorded): what recorded states are beyond declared limits, by noise

    def mean_square(self, signal: Array) -> Array:
        """Return the mean square of every channel over every episode, shape (batch, k)."""
        inside = (np.arange(len(signal))[:, None] < self.lengths)[..., None]
        return np.asarray(np.sum(np.where(inside, signal, 0.0) ** 2, axis=0) / self.lengths[:, None])

    def taken(self, observer: ObserverData) -> npt.NDArray[np.bool_]:
        """Whether the observer takes all samples, measurements at most at the limit and inputs within theirs, shape (batch,)."""
        found, u = screened(observer, self.y, self.inputs), observer.runtime.clip_inputs(self.inputs)
        good = np.isfinite(found.y).all(axis=-1) & (found.u == u).all(axis=-1)
        return np.asarray((good | (np.arange(len(good))[:, None] >= self.lengths)).all(axis=0))


def course(observer: ObserverData, batch: EpisodeBatch, estimates: Array | None = None) -> Course:
    """Return what drove an observer along recorded episodes; recorded states stand for the true ones, and no sample is lost."""
    inputs, at, late = batch.inputs, list(observer.measured), observer.runtime.delay
    states = observer.runtime.clip_estimate(batch.states)
    values = {**observer.parameters, **observer.own(batch.parameters)} if observer.lifting.parameters else None
    due = states[np.maximum(np.arange(len(states)) - late, 0)][..., at]
    y = (
        batch.states[np.maximum(np.arange(len(states)) - late, 0)][..., at]
        if batch.shown is None
        else batch.measurements(at, arrived=False)
    )
    if estimates is None:
        estimates = run_observer(observer, y, inputs, values)
    # Measurements beyond the limits of their states are taken at the limit: what is left of their noise is smaller.
    taken = screened(observer, y, inputs).y
    noise = np.where(np.isfinite(taken), taken, y)[:-1] - due[:-1]
    noise[:late] = 0.0
    omega = held_residual(observer, states, inputs, values)
    start = observer.initial(taken[0], values)
    return Course(
        omega,
        noise,
        first_error(observer, states[0] - start),
        states - estimates,
        batch.lengths,
        inputs,
        y,
        batch.states - states,
    )


def held_residual(
    observer: ObserverData, states: Array, inputs: Array, parameters: Mapping[str, npt.ArrayLike] | None
) -> Array:
    """Return the one-step residual, shape (n_samples - 1, batch, n); values before the first sample equal it."""
    h, inputs = observer.lifting.history, observer.runtime.clip_inputs(inputs)
    if h:
        states, inputs = (np.concatenate([np.repeat(v[:1], h, axis=0), v]) for v in (states, inputs))
    residual = one_step_residual(observer.lifting, observer.A, observer.B, states, inputs, parameters)
    residual[..., len(observer.recorded) :] = 0.0
    return residual


def first_error(observer: ObserverData, error: Array) -> Array:
    """Return the first error with the earlier ones that the lifting reads behind it, which equal it; shape (batch, n_window)."""
    states = observer.lifting.states
    earlier = [states.index(name) for name, delay in observer.lifting.window.quantities if delay and name in states]
    return np.concatenate([error, error[:, earlier]], axis=1)


def frozen_response(system: ErrorSystem, w: Array, first: Array) -> tuple[Array, Array]:
    """Return the scaled error with slopes at rest, and what the channels act on then."""
    plant = system.moved()
    start = first @ (np.eye(len(plant.A), first.shape[1]) if system.start is None else system.start).T
    drive = np.zeros((len(w) + 1, w.shape[1], len(plant.A)))
    np.matmul(w, plant.B[:, : w.shape[2]].T, out=drive[:-1])
    xi = recursion(plant.A, drive, start)
    moved = xi @ plant.C.T
    moved[:-1] += w @ plant.D[:, : w.shape[2]].T
    return xi @ system.C.T, moved
