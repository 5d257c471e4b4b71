"""The linear response of the error to what drove it, slopes at rest, beside the error and what the certificate allows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from kros.data import EpisodeBatch
from kros.observer import Observer, ReliftCertificate
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


def compared(
    certificate: ReliftCertificate, observer: Observer, batch: EpisodeBatch, estimates: Array | None = None
) -> list[Row]:
    """Compare responses, errors and bounds, episode by episode."""
    seen, lengths, scales = course(observer, batch), batch.lengths, certificate.scales
    if estimates is not None:
        states = np.clip(batch.states, *observer.runtime.sides(batch.states.shape[-1]))
        seen = replace(seen, error=states - estimates)
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.concatenate([seen.omega / scales.residual, seen.noise / scales.noise], axis=-1)
    w[np.isnan(w)] = 0.0
    inside = np.arange(len(seen.error))[:, None] < lengths
    z, _ = frozen_response(certificate.system(observer), w, seen.first)
    energy = [
        np.sum(np.where(inside[: len(s), :, None], s, 0.0) ** 2, axis=(0, 2)) for s in (z, seen.error / scales.error, w)
    ]
    energy[2] = certificate.gain**2 * energy[2] + np.sum(
        (seen.first @ certificate.start[:, : seen.first.shape[-1]].T @ certificate.root.T) ** 2, axis=-1
    )
    return [Row(*row) for row in np.sqrt(np.array(energy) / lengths).T]
