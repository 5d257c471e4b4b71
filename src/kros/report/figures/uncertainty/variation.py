"""How much of the uncertainty is the units and how much the finite recording, over frequency."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ....uncertainty import VariationAndNoise
from ...canvas import Axes, Figure, decibel, frequency_axis, grid, legend, lines_of_units, note
from ...names import form_label, model_label
from ...run_folder import RunFolder
from ...theme import Tone

_FLOOR_DB = 60.0


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw a column a model."""
    found = run.noise
    first = next(iter(found.values()))
    places = {name: int(one.residual.max(axis=0).argmax()) for name, one in found.items()}
    parts = [f"{model_label(n)} {100 * one.noise_share[places[n]]:.0f} % at {one.freqs_hz[places[n]]:.3g} Hz" for n, one in found.items()]
    text = (
        f"Above, blue: {form_label(first.form.value)} residuals of {len(first.unit_ids) - 1} units against the nominal one, "
        f"{first.unit_ids[first.nominal]}. Gold: what the residual of a unit against itself would stay below in {100 * first.level:.0f} % of cases, had other "
        "episodes been recorded; median unit, and from the smallest to the largest. Below: shares of the squared residual. "
        f"Share of finite recordings where units differ most: {', '.join(parts)}. "
        "A bias that all episodes of a unit share counts as a difference between units."
    )
    return variation_figure(found), text


def variation_figure(found: Mapping[str, VariationAndNoise]) -> Figure:
    """Draw residuals with the band of noise, and the shares below, a column a kind of model."""
    figure, axes = grid(2, len(found), 1.7, sharex=True, sharey="row", height_ratios=(1.5, 1))
    for column, (name, one) in zip(axes.T, found.items(), strict=True):
        _residuals(column[0], one)
        _shares(column[1], one)
        column[0].set_title(model_label(name))
        column[1].set_xlabel("frequency (Hz)")
    levels = [decibel(one.residual.max(axis=0)) for one in found.values()] + [decibel(one.band.max(axis=0)) for one in found.values()]
    finite = np.concatenate([level[np.isfinite(level)] for level in levels])
    if finite.size:
        axes[0, 0].set_ylim(max(finite.min() - 12, finite.max() - _FLOOR_DB), finite.max() + 4)
    axes[0, 0].set_ylabel("residual (dB)")
    axes[1, 0].set_ylabel("share (%)")
    legend(figure, axes[0, 0])
    return figure


def _residuals(axes: Axes, found: VariationAndNoise) -> None:
    freqs, band = found.freqs_hz, decibel(found.band)
    axes.fill_between(freqs, band.min(axis=0), band.max(axis=0), color=Tone.GOLD.light, alpha=0.3, lw=0)
    others = np.arange(len(found.residual)) != found.nominal
    names = [u for k, u in enumerate(found.unit_ids) if k != found.nominal]
    lines_of_units(axes, freqs, decibel(found.residual[others]), Tone.BLUE.light, "units against the nominal", names)
    axes.plot(freqs, decibel(found.residual.max(axis=0)), color=Tone.BLUE.light, lw=1.5, label="largest")
    axes.plot(freqs, np.median(band, axis=0), color=Tone.GOLD.light, lw=1.5, ls="--", label="finite recordings alone")
    frequency_axis(axes, freqs, "", 4)


def _shares(axes: Axes, found: VariationAndNoise) -> None:
    freqs, share = found.freqs_hz, 100 * found.noise_share
    axes.fill_between(freqs, 0, share, color=Tone.GOLD.light, alpha=0.55, lw=0)
    axes.fill_between(freqs, share, 100, color=Tone.BLUE.light, alpha=0.35, lw=0)
    axes.plot(freqs, share, color=Tone.GOLD.light, lw=1.2)
    middle = float(np.mean(share))
    if middle < 70:
        note(axes, "units differ", (0.04, 0.93), va="top", color=Tone.INK.light)
    if middle > 20:
        note(axes, "recordings", (0.04, 0.07), va="bottom", color=Tone.INK.light)
    axes.set_ylim(0, 100)
    frequency_axis(axes, freqs, "", 4)
