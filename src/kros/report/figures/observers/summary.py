"""Spectra of estimation errors, a column a state. For plots of results in memory."""

from __future__ import annotations

import numpy as np

from ....evaluate.errors import ErrorSummary
from ...canvas import Figure, frequency_axis, grid, legend, lines_of_units
from ...names import number
from ...theme import Tone


def summary_figure(errors: ErrorSummary) -> Figure:
    """Draw the error's power spectral density in every episode and their mean; titles say the mean error in percent of the largest value."""
    freqs, spectra = errors.freqs_hz[1:], 10 * np.log10(np.maximum(errors.spectra[:, 1:], 1e-300))
    mean = 10 * np.log10(np.maximum(errors.spectra[:, 1:].mean(axis=0), 1e-300))
    figure, axes = grid(1, spectra.shape[-1], 2.2)
    for i, panel in enumerate(axes[0]):
        lines_of_units(panel, freqs, spectra[..., i], Tone.BLUE.light, f"{len(spectra)} episodes")
        panel.plot(freqs, mean[:, i], color=Tone.INK.light, label="mean")
        frequency_axis(panel, freqs, most=4)
        panel.set_title(f"state {i + 1}: {number(float(errors.percent[:, i].mean()))} %")
    axes[0, 0].set_ylabel("error's PSD (dB/Hz)")
    legend(figure, axes[0, 0])
    return figure
