"""Spectra of the free-run errors of the linear and the Koopman model, linear and logarithmic (the paper's Figure 6)."""

from __future__ import annotations

from ...canvas import Figure
from ...names import best_models, model_label, model_look
from ...run_folder import NotShownError, RunFolder
from ..spectra import SpectraRow, share_text, spectra_figure


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw the mean spectra over all held-out episodes."""
    found = {
        n: run.arrays[f"spectrum/model/{n}"] for n in run.evaluation["models"] if f"spectrum/model/{n}" in run.arrays
    }
    chosen = best_models(found)
    if not chosen:
        raise NotShownError("no model was run freely on held-out episodes")
    spectra = {model_label(n): (found[n], model_look(n)) for n in chosen}
    figure = spectra_figure(
        run, [SpectraRow("PSD, linear", spectra), SpectraRow("PSD, logarithmic", spectra, logarithmic=True)], 1.55
    )
    text = "Power spectral densities of the free-run errors, mean over all held-out episodes."
    if run.band_hz and len(chosen) == 2:
        shares = share_text(run, found[chosen[1]], found[chosen[0]], run.band_hz)
        text += (
            f" Shaded: the band around the gearbox frequency at top speed, where the {model_label(chosen[1])} model leaves, relative to the "
            f"{model_label(chosen[0])} one, this much power: {shares}. Linear scales end at the largest value above 10 Hz."
        )
    return figure, text
