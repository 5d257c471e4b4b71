"""Spectra of the free-run errors of the linear and the Koopman model, linear and logarithmic (the paper's Figure 6).

Needs: the evaluation's model spectra.
"""

from __future__ import annotations

from ..canvas import grid, legend
from ..names import best_models, model_label, model_look
from ..run_folder import NotShownError, RunFolder
from .drawing import Drawing
from .spectra import band, band_shares, density_label, draw_spectra, robust_top, share_text
from .trajectories import states

NAME, TITLE = "free_run_spectra", "Spectra of the prediction errors"


def draw(run: RunFolder) -> Drawing:
    """Draw the mean spectra over all held-out episodes."""
    chosen = best_models([n for n in run.evaluation["models"] if f"spectrum/model/{n}" in run.arrays])
    if not chosen:
        raise NotShownError("no model was run freely on held-out episodes")
    freqs, channels = run.arrays["freqs_hz"], states(run)[:4]
    spectra = {model_label(n): (run.arrays[f"spectrum/model/{n}"], model_look(n)) for n in chosen}
    figure, axes = grid(2, len(channels), 1.55, sharex=True)
    band_hz = run.evaluation.get("band_hz")
    top = min(3.5 * band_hz[1], freqs[-1]) if band_hz else None
    for row, logarithmic in zip(axes, (False, True), strict=True):
        draw_spectra(row, freqs, spectra, logarithmic, top)
        for panel in row:
            band(panel, band_hz)
    robust_top(axes[0], freqs, [d for d, _ in spectra.values()], 10.0 if band_hz else 0.0)
    for i, channel in enumerate(channels):
        axes[0, i].set_title(density_label(channel))
        axes[-1, i].set_xlabel("frequency (Hz)")
    axes[0, 0].set_ylabel("PSD, linear")
    axes[1, 0].set_ylabel("PSD, logarithmic")
    legend(figure, axes[0, 0])
    text = "Power spectral densities of the free-run errors, mean over all held-out episodes."
    if band_hz and len(chosen) == 2:
        own, other = (run.arrays[f"spectrum/model/{n}"] for n in reversed(chosen))
        shares = share_text(band_shares(freqs, own, other, channels, band_hz), channels)
        text += (
            f" Shaded: the band around the gearbox frequency at top speed, where the {model_label(chosen[1])} model leaves, relative to the "
            f"{model_label(chosen[0])} one, this much power: {shares}. Linear scales end at the largest value above 10 Hz."
        )
    return Drawing(figure, text)
