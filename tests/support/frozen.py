"""The linear response of the error to what drove it, slopes at rest, beside the error and what the certificate allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kros.data import EpisodeBatch
from kros.observer import Observer, ReliftCertificate, run_observer
from kros.observer.certificate.signals import course, frozen_response

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """Root mean squares of one episode, signals divided by their sizes."""

    frozen: float
    error: float
    bound: float

    @property
    def holds(self) -> bool:
        """Whether the error is within the bound, rounding aside."""
        return self.error <= self.bound * (1 + 1e-6)


def as_shown(observer: Observer, batch: EpisodeBatch) -> Array:
    """Estimate from measurements as the sensor shows them, or as late as they arrive."""
    at, due = list(observer.measured), np.maximum(np.arange(len(batch.states)) - observer.runtime.delay, 0)
    y = batch.states[due][..., at] if batch.shown is None else batch.measurements(at, arrived=False)
    return run_observer(observer, y, batch.inputs, observer.own(batch.parameters))


def compared(
    certificate: ReliftCertificate, observer: Observer, batch: EpisodeBatch, estimates: Array | None = None
) -> list[Row]:
    """Compare responses, errors and bounds, episode by episode."""
    seen, lengths, scales = course(observer, batch), batch.lengths, certificate.scales
    states = np.clip(batch.states, *observer.runtime.sides(batch.states.shape[-1]))
    error = states - (as_shown(observer, batch) if estimates is None else estimates)
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.concatenate([seen.omega / scales.residual, seen.noise / scales.noise], axis=-1)
    w[np.isnan(w)] = 0.0
    inside = np.arange(len(error))[:, None] < lengths
    z, _ = frozen_response(certificate.system(observer), w, seen.first)
    energy = [
        np.sum(np.where(inside[: len(s), :, None], s, 0.0) ** 2, axis=(0, 2)) for s in (z, error / scales.error, w)
    ]
    energy[2] = certificate.gain**2 * energy[2] + np.sum(
        (seen.first @ certificate.start[:, : seen.first.shape[-1]].T @ certificate.root.T) ** 2, axis=-1
    )
    return [Row(*row) for row in np.sqrt(np.array(energy) / lengths).T]
