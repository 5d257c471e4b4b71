"""Validation as in system identification: correlation of residuals, spectra and coherence of excitations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core import Array
from ..data import EpisodeKey, Population


def correlation(later: Array, earlier: Array, lags: int) -> Array:
    """Return the correlation coefficients of a signal with another 0, 1, ..., `lags` samples before."""
    from scipy.signal import correlate

    x, y = later - later.mean(), earlier - earlier.mean()
    size = np.sqrt(x @ x * (y @ y))
    return np.asarray(correlate(x, y)[len(y) - 1 :][: lags + 1] / (size if size > 0 else np.nan))


def excitation(
    population: Population, keys: Sequence[EpisodeKey], segment: int, averages: int
) -> tuple[Array, Array, Array]:
    """Return frequencies, Hz, power densities of channels (channel, frequency), and coherences (channel, channel, ...).

    Spectra are means over episodes by Welch's method, with segments so short that the shortest episode has `averages`.
    The coherence ``|S_ij|^2 / (S_ii S_jj)`` is the ordinary one, NaN where a channel is constant.
    """
    from scipy.signal import csd

    episodes = [population.read(key).T for key in keys]
    size = max(1, min(segment, min(x.shape[1] for x in episodes) // averages))
    spectra = [csd(x[:, None], x, 1 / population.sample_period_s, nperseg=size) for x in episodes]
    mean = np.average([s for _, s in spectra], axis=0, weights=[x.shape[1] for x in episodes])
    power = np.einsum("iif->if", mean).real
    power = np.where(power > 0, power, np.nan)
    return spectra[0][0], power, np.abs(mean) ** 2 / (power[:, None] * power)
