"""Share of estimation noise in the differences between units: what recordings of finite length explain.

    bootstrapped models of every unit --responses--> draws (unit, draw, frequency)
    total(f) = mean over pairs of units   |E(G_k, G_i)|_F^2          what is seen: variation and noise of both estimates
    noise(f) = mean over pairs of draws   |E(G_i*, G_i**)|_F^2       what would be seen of identical units
    ratio(f) = noise / total

For the additive form the noise of both estimates adds to the squared difference, so the ratio is an unbiased comparison
of mean squares (the within over the total mean square of a one-way random-effects analysis of variance); for the other
forms it is one to first order in the residual. It scatters: with identical units around one, by about ``sqrt(2 / (units
- 1))`` and less. The share is the ratio cut at one.

What the bootstrap does not see is not in it: a bias that all episodes share counts as variation where it differs
between units.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core import AnyArray, frozen, save_artifact
from ..core.linalg import energy, pieces, sigma_max
from ..identify.edmd import ModelSamples
from .forms import Form, evenly, residual
from .settings import OUTLIER


@frozen
class NoiseShare:
    """Mean squared residuals of a population and the part of them that recordings explain."""

    freqs_hz: AnyArray  # (frequency,), Hz
    total: AnyArray  # (frequency,): mean squared Frobenius norm of residuals between units
    noise: AnyArray  # (frequency,): the same between resampled models of one unit
    largest: AnyArray  # (frequency,): largest singular value of the residuals against the nominal unit

    @property
    def ratio(self) -> AnyArray:
        """Noise over total, shape (frequency,); above one where chance has it, zero where there is neither."""
        return np.divide(self.noise, self.total, out=np.where(self.noise > 0, np.inf, 0.0), where=self.total > 0)

    def facts(self) -> dict[str, float]:
        """Return the median share, and the share where units differ most from the nominal one."""
        share, top = np.minimum(self.ratio, 1.0), int(self.largest.argmax())
        return {"median": float(np.median(share)), "at_peak": float(share[top]), "peak_hz": float(self.freqs_hz[top])}

    def save(self, folder: Path) -> None:
        """Write ``noise_share.json``."""
        save_artifact(folder, "noise_share", self.facts())


def noise_share(
    models: ModelSamples, scale: AnyArray, freqs_hz: AnyArray, sample_period_s: float, form: Form, nominal: int = 0
) -> NoiseShare:
    """Compare the residuals between units with those between resampled models, of responses divided by `scale`."""
    (units, draws, _, n), m = models.samples.A.shape, models.samples.B.shape[-1]
    G = models.estimate.responses(freqs_hz, sample_period_s) / scale  # (unit, frequency, n, m)
    noise, blocks = np.zeros(len(freqs_hz)), pieces(len(freqs_hz), OUTLIER.at_once // (draws * n * max(n, m)))
    for row in range(units):
        for part in blocks:
            drawn = models.samples[row].responses(freqs_hz[part], sample_period_s) / scale  # (draw, frequency, n, m)
            noise[part] += energy(residual(form, drawn, np.roll(drawn, 1, axis=0))).mean(axis=0) / units
    between = np.mean([energy(residual(form, G[k], G)) for k in evenly(units, OUTLIER.nominals)], axis=(0, 1))
    largest = sigma_max(residual(form, G[nominal], G)).max(axis=0)
    return NoiseShare(freqs_hz, between * units / (units - 1), noise, largest)
