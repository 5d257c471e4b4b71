"""Uncertainty from frequency responses alone: no state space is needed, and nothing is claimed between or beyond the frequencies given."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError
from ..core.frequency import check_grid
from .bilinear import BilinearAxis
from .forms import Form, check_responses
from .model import ResponseUncertainty
from .nominal.choice import choose_nominals
from .quantification import AUTO, Quantification
from .validation import check_ids, check_scale, find_nominal
from .weights.check import nearest

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
_RESOLVED, _ROUNDING = 10 ** (3 / 20), 1e-8


def quantify_responses(
    responses: npt.ArrayLike,
    freqs_hz: npt.ArrayLike,
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    *,
    sample_period_s: float = 0.0,
    unit_ids: Sequence[str] | None = None,
    output_scale: npt.ArrayLike | None = None,
    input_scale: npt.ArrayLike | None = None,
    nominal: int | str | npt.ArrayLike | None = None,
    max_order: int = 4,
    tolerance_db: float = 1.0,
) -> ResponseUncertainty:
    """Quantify how frequency responses of units differ from a nominal one.

    The weights are stable systems and bound the residuals at every frequency given, which is checked for the weights as returned; so is what they say
    about the tolerance. Between and beyond these frequencies the responses are not known, and nothing is claimed: take a grid that resolves every
    resonance. Peaks that it does not resolve are named, with a warning.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
    freqs_hz : array_like, shape (frequency,), Hz
    form : Form or str
    sample_period_s : float, s
        Of the systems behind the responses, and of the weights; zero for continuous time, in which weights are fitted through the bilinear map of the axis.
    nominal : int, str or array_like of shape (frequency, p, m), optional
        A unit, or a response of its own; by default the best unit.
    unit_ids, output_scale, input_scale, max_order, tolerance_db
        As of `quantify_systems`.

    Returns
    -------
    ResponseUncertainty

    Raises
    ------
    DimensionError
        Shapes that do not fit together.
    DataError
        Fewer than two units, NaN.
    ConfigError
        Frequencies that do not increase or are above Nyquist; unknown form or nominal.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import quantify_responses
    >>> freqs = np.geomspace(0.01, 100.0, 50)
    >>> gains = np.array([0.9, 1.0, 1.2])
    >>> lags = gains[:, None] / (1 + 2j * np.pi * freqs)
    >>> found = quantify_responses(lags[:, :, None, None], freqs, "output_multiplicative")
    >>> found.nominal, found.weight.cover_max <= 1
    (1, True)
    >>> round(float(abs(found.weight.left.frequency_response([1.0])[0, 0, 0])), 6)
    0.2
    """
    asked = Quantification.of(form, AUTO, max_order, tolerance_db)
    G = check_responses(responses)
    freqs = check_grid(freqs_hz, sample_period_s or None)
    if G.shape[1] != len(freqs):
        raise DimensionError(
            f"Quantify: responses at {G.shape[1]} frequencies need as many in freqs_hz, found {len(freqs)}."
        )
    ids = check_ids(unit_ids, len(G))
    own = nominal is not None and not isinstance(nominal, str) and np.ndim(nominal) > 0
    for name, value in zip((*ids, "the nominal"), [*G, np.asarray(nominal)] if own else G, strict=False):
        _check(name, value, G.shape[1:], freqs)
    scales = check_scale("output", output_scale, G.shape[2]), check_scale("input", input_scale, G.shape[3])
    units = G / scales[0][:, None] * scales[1]
    choices = choose_nominals(units)
    index = -1 if own else find_nominal(nominal, ids, choices[asked.form].index)
    chosen = np.asarray(nominal) if own else G[index]
    base = chosen / scales[0][:, None] * scales[1]
    time = sample_period_s if sample_period_s > 0 else BilinearAxis.over(freqs)
    found = asked.bound(
        lambda f: base[nearest(freqs, f)], lambda f: units[:, nearest(freqs, f)], freqs, time, sampled=True
    )
    unresolved = freqs[unresolved_peaks(found.bound)]
    certificate = (
        f"at the {len(freqs)} frequencies given, {freqs[0]:.6g} to {freqs[-1]:.6g} Hz; not between or beyond them"
    )
    if unresolved.size:
        some = ", ".join(f"{f:.4g}" for f in unresolved[:5]) + (" ..." if unresolved.size > 5 else "")
        certificate += (
            f"; they do not resolve {unresolved.size} peak{'s' * (unresolved.size > 1)} of the residuals, at {some} Hz"
        )
        _LOG.warning(
            "Weights of responses: the residuals peak within less than a step of the frequencies given, at %s Hz, and may be larger beside them; "
            "measure more densely there.",
            some,
        )
    return ResponseUncertainty(
        nominal_response=chosen,
        sample_period_s=float(sample_period_s),
        certificate=certificate,
        unresolved_hz=unresolved,
        **asked.fields(ids, index, freqs, scales, choices, found),
    )


def unresolved_peaks(bound: Array) -> npt.NDArray[np.intp]:
    """Return the indices of inner local maxima from which a bound, shape (frequency,), falls by more than 3 dB to a neighbour."""
    middle, before, after = bound[1:-1], bound[:-2], bound[2:]
    peaks = (
        (middle >= before)
        & (middle >= after)
        & (middle > np.maximum(_RESOLVED * np.minimum(before, after), _ROUNDING * bound.max()))
    )
    return np.flatnonzero(peaks) + 1


def _check(name: str, response: Array, shape: tuple[int, ...], freqs: Array) -> None:
    """Raise a `DimensionError` or `DataError` when a response is not like the others, or not finite."""
    if response.shape != shape:
        raise DimensionError(
            f"Quantify: the response of {name!r} should have the shape {shape}, found {response.shape}."
        )
    finite = np.isfinite(response).all(axis=(1, 2))
    if not finite.all():
        at = freqs[int(np.argmin(finite))]
        raise DataError(
            f"Quantify: the response of {name!r} has NaN or infinity at {at:.6g} Hz; leave it or the frequency out."
        )
