"""Frequency responses of an estimate with the bands that its uncertainty leaves, per unit and frequency by frequency.

    samples of (A, B) --> G* - G at every frequency --> quantiles over the draws of sigma_max (scaled) and of every entry's magnitude

First-order samples (`ModelSamples.linear`) have first-order deviations, ``dG = Phi dW [G; I]`` with Phi = (zI - A)^-1 and W = [A B].

A band is pointwise: the true response lies inside at a given frequency with the stated probability, and outside somewhere more often. It
holds what recordings of the unit vary by; it is not the population's uncertainty, which the units' differences make.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, save_artifact
from ..core.errors import ConfigError, DimensionError
from ..core.frequency import check_grid
from ..core.linalg import adjoint
from ..core.loading import check_shapes, loader
from ..core.lti import StateSpace
from .bootstrap import ModelSamples
from .edmd import KoopmanMatrices

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[Any]
_AT_ONCE = 8_000_000  # complex numbers in memory


@dataclass(frozen=True, eq=False)
class Bands:
    """Pointwise bands around the frequency responses of all units, from input to lifted state.

    Parameters
    ----------
    unit_ids : tuple of str
    freqs_hz : ndarray, shape (frequency,), Hz
    level : float
        Probability with which the true response lies inside, pointwise.
    response : ndarray, shape (unit, frequency, n, m), complex
        Of the estimate.
    entry : ndarray, shape (unit, frequency, n, m)
        Radius of the disc around each entry.
    spectral : ndarray, shape (unit, frequency)
        Radius in sigma_max of the deviation in scaled inputs and outputs.
    output_scale, input_scale : ndarray, shape (n,) and (m,)
    """

    unit_ids: tuple[str, ...]
    freqs_hz: Array
    level: float
    response: Complex
    entry: Array
    spectral: Array
    output_scale: Array
    input_scale: Array

    def save(self, folder: Path) -> None:
        """Write ``arrays.npz`` and ``bands.json``."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        save_artifact(folder, "bands", {"unit_ids": self.unit_ids, "level": self.level}, arrays)

    @classmethod
    @loader
    def load(cls, folder: Path) -> Bands:
        """Read what `save` wrote."""
        content, arrays = load_artifact(folder, "bands")
        axes = {"freqs_hz": "f", "response": "ufnm", "entry": "ufnm", "spectral": "uf", "output_scale": "n", "input_scale": "m"}
        check_shapes(arrays, axes, {"u": len(content["unit_ids"])}, Path(folder))
        return cls(unit_ids=tuple(content["unit_ids"]), level=content["level"], **{name: arrays[name] for name in _ARRAYS})


_ARRAYS = ("freqs_hz", "response", "entry", "spectral", "output_scale", "input_scale")


def response_bands(
    models: ModelSamples,
    freqs_hz: npt.ArrayLike,
    sample_period_s: float,
    output_scale: npt.ArrayLike | None = None,
    input_scale: npt.ArrayLike | None = None,
    level: float = 0.95,
) -> Bands:
    """Return the bands that resampled models span around the estimate.

    Parameters
    ----------
    models : ModelSamples
    freqs_hz : array_like, shape (frequency,), Hz
    sample_period_s : float, s
    output_scale, input_scale : array_like, shape (n,) and (m,), optional
        Ranges of lifted states and inputs, as in `ModelSet`; ones by default.
    level : float
        Quantile over the draws.

    Returns
    -------
    Bands

    Raises
    ------
    ConfigError
        When `level` is no probability, or the frequencies are no grid.
    DimensionError
        When scales do not fit, or are not positive.
    """
    freqs = check_grid(freqs_hz, sample_period_s)
    if not 0 < level < 1:
        raise ConfigError(f"Bands: level should be between 0 and 1, found {level}; 0.95 is usual.")
    A, B = models.samples.A, models.samples.B
    units, draws, n, m = *A.shape[:2], A.shape[-1], B.shape[-1]
    scale_out, scale_in = (_scale(s, size) for s, size in ((output_scale, n), (input_scale, m)))
    response = np.empty((units, len(freqs), n, m), dtype=complex)
    entry, spectral = np.empty((units, len(freqs), n, m)), np.empty((units, len(freqs)))
    deviation = _linear_deviation if models.linear else _deviation
    for row in range(units):
        estimate = KoopmanMatrices(models.estimate.A[row], models.estimate.B[row])
        samples = KoopmanMatrices(A[row], B[row])
        response[row] = _response(estimate, freqs, sample_period_s)
        for part in _parts(len(freqs), draws * n * (n + m)):
            off = deviation(estimate, samples, response[row, part], freqs[part], sample_period_s)  # (draw, frequency, n, m)
            entry[row, part] = np.quantile(np.abs(off), level, axis=0)
            spectral[row, part] = np.quantile(_largest_gain(off * scale_in / scale_out[:, None]), level, axis=0)
    return Bands(models.unit_ids, freqs, level, response, entry, spectral, scale_out, scale_in)


def _deviation(estimate: KoopmanMatrices, samples: KoopmanMatrices, G: Complex, freqs_hz: Array, sample_period_s: float) -> Complex:
    return np.asarray(_response(samples, freqs_hz, sample_period_s) - G)


def _linear_deviation(estimate: KoopmanMatrices, samples: KoopmanMatrices, G: Complex, freqs_hz: Array, sample_period_s: float) -> Complex:
    """``dG = Phi dW [G; I]``."""
    Phi = _response(KoopmanMatrices(estimate.A, np.eye(len(estimate.A))), freqs_hz, sample_period_s)
    dA, dB = samples.A - estimate.A, samples.B - estimate.B
    return np.asarray(Phi @ (dA[:, None] @ G + dB[:, None]))


def _response(models: KoopmanMatrices, freqs_hz: Array, sample_period_s: float) -> Complex:
    n, m = models.B.shape[-2:]
    C, D = (np.broadcast_to(M, (*models.A.shape[:-2], *M.shape)) for M in (np.eye(n), np.zeros((n, m))))
    return StateSpace(models.A, models.B, C, D, sample_period_s).frequency_response(freqs_hz)


def _largest_gain(G: Complex) -> Array:
    """Largest singular value, from the Gram matrix of the shorter side: deviations are far above rounding."""
    tall = G if G.shape[-2] >= G.shape[-1] else np.swapaxes(G, -1, -2)
    size = np.maximum(np.abs(tall).max(axis=(-1, -2), keepdims=True), np.finfo(float).tiny)
    gram = adjoint(tall) / size @ (tall / size)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(gram)[..., -1]) * size[..., 0, 0])


def _scale(scale: npt.ArrayLike | None, size: int) -> Array:
    values = np.ones(size) if scale is None else np.asarray(scale, dtype=float)
    if values.shape != (size,) or not (np.isfinite(values).all() and (values > 0).all()):
        raise DimensionError(f"Bands: a scale should hold {size} positive numbers, found {values.tolist()}.")
    return values


def _parts(count: int, size: int) -> Iterator[slice]:
    step = max(1, _AT_ONCE // size)
    return (slice(start, start + step) for start in range(0, count, step))
