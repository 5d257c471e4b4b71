"""Shared by the figures of error spectra: a column a state, a row a scale or role, labels at the lines' peaks or in a legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...data.population import Channel
from ..canvas import frequency_axis
from ..canvas import logarithmic as logarithmic_axis
from ..names import Look, axis_label, number, squared
from ..theme import Tone

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = npt.NDArray[Any]


def draw_spectra(
    row: Sequence[Axes], freqs_hz: Array, spectra: Mapping[str, tuple[Array, Look]], logarithmic: bool, top_hz: float | None
) -> None:
    """Draw the spectra of all states in one row of axes.

    Parameters
    ----------
    row : sequence of Axes
        One a state.
    freqs_hz : ndarray, shape (n_freqs,), Hz
    spectra : mapping of label to (ndarray, shape (n_freqs, n), Look)
    logarithmic : bool
        Scale of the vertical axis.
    top_hz : float or None
        End of a linear frequency axis; None for a logarithmic one up to Nyquist.
    """
    inside = (freqs_hz <= (top_hz or np.inf)) & (freqs_hz > 0)
    for i, axes in enumerate(row):
        for label, (density, look) in spectra.items():
            line = density[inside, i]
            if np.isfinite(line).all():
                axes.plot(freqs_hz[inside], line, look.style, color=look.colour, label=label, lw=1.2)
        if top_hz is None:
            frequency_axis(axes, freqs_hz, "")
        else:
            axes.set_xlim(0, top_hz)
        if logarithmic:
            logarithmic_axis(axes)
        else:
            axes.set_ylim(bottom=0)


def robust_top(row: Sequence[Axes], freqs_hz: Array, spectra: Sequence[Array], above_hz: float) -> None:
    """End linear axes at the largest value above a frequency, so that a low-frequency offset does not flatten the rest."""
    inside = freqs_hz >= above_hz
    for i, axes in enumerate(row):
        tops = [float(d[inside, i].max()) for d in spectra if np.isfinite(d[inside, i]).all()]
        if tops and max(tops) > 0:
            axes.set_ylim(0, 1.1 * max(tops))


def band(axes: Axes, band_hz: Sequence[float] | None) -> None:
    """Mark the band around the gearbox frequency."""
    if band_hz is not None:
        axes.axvspan(band_hz[0], band_hz[1], color=Tone.GRID.light, lw=0, zorder=0.5)


def band_shares(freqs_hz: Array, own: Array, other: Array, channels: Sequence[Channel], band_hz: Sequence[float]) -> dict[str, float]:
    """Return the power inside a band relative to another's, by channel.

    Parameters
    ----------
    freqs_hz : ndarray, shape (n_freqs,), Hz
    own, other : ndarray, shape (n_freqs, n)
    channels : sequence of Channel
    band_hz : (float, float)
    """
    inside = (freqs_hz >= band_hz[0]) & (freqs_hz <= band_hz[1])
    power = own[inside].sum(axis=0), other[inside].sum(axis=0)
    return {c.name: float(power[0][i] / power[1][i]) for i, c in enumerate(channels) if power[1][i] > 0 and np.isfinite(power[0][i])}


def share_text(shares: Mapping[str, float], channels: Sequence[Channel]) -> str:
    """Return shares for a sentence: ``velocity 20 %, current 3 %``; what is measured needs no estimate and is left out."""
    hidden = {c.name for c in channels if not c.measured} or set(shares)
    return ", ".join(f"{name} {number(100 * share, 2)} %" for name, share in shares.items() if name in hidden)


def density_label(channel: Channel) -> str:
    """Return the label of a power spectral density."""
    return f"{axis_label(channel.name, '')} error, {squared(channel.unit)}/Hz"
