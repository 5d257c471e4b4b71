"""Errors and spectra of estimates (section IV-E), and errors against what states really were.

A recorded state may itself be an estimate: a drive's velocity is a filtered difference of positions, which trails. An
observer that was made to agree with the recording then trails as well, and its error against the recording does not
show it; error and lag against the truth do.
"""

import numpy as np

from ..core import Array, Whole


def errors_of(
    estimate: Array, truth: Array, lengths: Whole, dt: float, band_hz: tuple[float, float] | None = None
) -> dict[str, Array]:
    """Return the errors of an estimate, (n_samples, batch, n or more), by their keys in the metrics, (batch, n) each.

    ``gearbox_band_power`` is the power of the error inside a band, by Welch's power spectral density.
    """
    estimate = estimate[..., : truth.shape[2]]
    rms = error_rms(estimate, truth, lengths)
    known = {"rms": rms, "error_percent": _percent(rms, largest(truth, lengths))}
    if band_hz is not None:
        known["gearbox_band_power"] = power = np.empty_like(rms)
        for i, length in enumerate(lengths):
            with np.errstate(over="ignore", invalid="ignore"):
                freqs_hz, density = error_spectrum(estimate[:length, i] - truth[:length, i], dt)
                inside = (freqs_hz >= band_hz[0]) & (freqs_hz <= band_hz[1])
                power[i] = density[inside].sum(axis=0) * freqs_hz[1]
    return known


def error_rms(estimate: Array, truth: Array, lengths: Whole) -> Array:
    """Return the root mean square error of every episode, shape (batch, n)."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = estimate - truth
        error[np.arange(len(truth))[:, None] >= lengths] = 0.0
        return np.sqrt(np.einsum("kbn,kbn->bn", error, error) / lengths[:, None])


def error_percent(estimate: Array, truth: Array, lengths: Whole) -> Array:
    """Return ``100 rms(x_hat - x) / max|x|`` of every episode, shape (batch, n), NaN for a state at zero.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import error_percent
    >>> recorded = np.array([0.0, 2.0, -4.0]).reshape(3, 1, 1)  # sample, episode, state
    >>> error_percent(recorded + 0.1, recorded, np.array([3])).round(9).tolist()
    [[2.5]]
    """
    return _percent(error_rms(estimate, truth, lengths), largest(truth, lengths))


def largest(truth: Array, lengths: Whole) -> Array:
    """Return the largest absolute values of episodes, shape (batch, n)."""
    return np.max(np.abs(truth), axis=0, where=np.arange(len(truth))[:, None, None] < lengths[:, None], initial=0.0)


def _percent(rms: Array, largest: Array) -> Array:
    return np.divide(100 * rms, largest, out=np.full_like(rms, np.nan), where=largest > 0)


def error_spectrum(error: Array, dt: float, segment: int = 512) -> tuple[Array, Array]:
    """Return frequencies and one-sided power density of an error by Welch's method: half overlapping Hann windows.

    Their length in samples is that of the paper.
    """
    from scipy.signal import welch

    return welch(error, 1 / dt, nperseg=min(segment, len(error)), nfft=segment, axis=0)


def true_errors(signals: Array, truths: Array, lengths: Whole, dt: float) -> dict[str, Array]:
    """Return the errors of signals against truths, (n_samples, batch, n), and how late they are, see `delay_samples`.

    Keys are those of the metrics, values have the shape (batch, n); NaN is unknown.
    """
    lag = np.array([delay_samples(signals[:n, i], truths[:n, i]) for i, n in enumerate(lengths)])
    errors = errors_of(signals, truths, lengths, dt)
    return {f"true_{name}": values for name, values in errors.items()} | {"true_lag_s": lag * dt}


def delay_samples(signals: Array, truths: Array) -> Array:
    """Return the delay of truths, at most 200 samples, that fits signals best; a parabola refines the least cost."""
    from scipy.signal import fftconvolve

    n = len(signals)
    most = min(200, n // 4)  # samples
    if most < 1:
        return np.full(signals.shape[1:], np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        y, x = (values - truths.mean(axis=0) for values in (signals[most : n - most], truths))
        common = fftconvolve(x, y[::-1], mode="valid", axes=0)
        energy = np.cumsum(np.concatenate([np.zeros((1, *x.shape[1:])), x**2]), axis=0)
        cost = energy[n - 2 * most :] - energy[: 2 * most + 1] - 2 * common
        best = cost.argmin(axis=0)
        middle = np.clip(best, 1, 2 * most - 1)
        left, least, right = (np.take_along_axis(cost, (middle + side)[None], axis=0)[0] for side in (-1, 0, 1))
        bend = left - 2 * least + right
        delay = most - middle - 0.5 * (left - right) / bend
    known = np.isfinite(signals).all(axis=0) & (np.ptp(x, axis=0) > 0) & (best == middle) & (bend > 0)
    return np.where(known, delay, np.nan)


def fit_percent(estimate: Array, recorded: Array) -> Array:
    """Return ``100 (1 - |x - x_hat| / |x - mean(x)|)`` of every column, shape (n,), NaN for a constant one.

    This is the fit of MATLAB's ``compare``: 100 % is exact, the mean of the recording has 0 %.

    Parameters
    ----------
    estimate, recorded : ndarray, shape (n_samples, n)
        Euclidean norms are over the samples of one episode.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import fit_percent
    >>> recorded = np.array([[0.0], [2.0], [4.0]])  # less their mean: the norm is the root of 8
    >>> fit_percent(recorded + np.array([[1.0], [0.0], [1.0]]), recorded).round(9).tolist()
    [50.0]
    """
    spread = np.linalg.norm(recorded - recorded.mean(axis=0), axis=0)
    ratio = np.linalg.norm(recorded - estimate, axis=0) / np.where(spread > 0, spread, np.nan)
    return 100 * (1 - ratio)
