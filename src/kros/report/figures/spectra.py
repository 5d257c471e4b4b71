"""Shared by the figures of error spectra: rows of linear or logarithmic scale, a column a state, the gearbox band marked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...data.population import Channel
from ...evaluate.errors import error_spectrum
from ..canvas import Array, Figure, frequency_axis, grid, label_below, legend, logarithmic
from ..names import Look, axis_label, number, observer_label, observer_look, split_observer, squared
from ..run_folder import RunFolder, Shown
from ..theme import Tone

_MOST = 4  # states that are shown
_ABOVE = (
    0.01  # of the sampling frequency: offsets below would flatten the rest of a linear scale of a study with a gearbox
)


@dataclass(frozen=True, eq=False)
class SpectraRow:
    """One row of axes: its label, densities of shape (n_freqs, n) with their looks by label, the scale, and which lines a linear scale is cut to."""

    label: str
    spectra: Mapping[str, tuple[Array, Look]]
    logarithmic: bool = False
    compared: Sequence[str] | None = None


def observer_row(label: str, spectra: Mapping[str, Array], logarithmic: bool = False) -> SpectraRow:
    """Return a row of observers by their names; a linear scale is cut to those with a correction."""
    lines = {observer_label(n): (density, observer_look(n)) for n, density in spectra.items()}
    return SpectraRow(
        label, lines, logarithmic, [observer_label(n) for n in spectra if split_observer(n)[1] != "open_loop"]
    )


def of_episode(run: RunFolder, shown: Shown, names: Sequence[str]) -> dict[str, Array]:
    """Return the spectra of the errors in one kept episode, by observer."""
    with np.errstate(over="ignore", invalid="ignore"):
        return {
            n: error_spectrum(shown.observers[n].astype(float) - shown.states, run.sample_period_s)[1] for n in names
        }


def spectra_figure(run: RunFolder, rows: Sequence[SpectraRow], height_in: float, columns: int | None = None) -> Figure:
    """Draw rows of spectra, a column a state; `columns` are those of the legend."""
    freqs, band_hz, channels = run.arrays["freqs_hz"], run.band_hz, run.states[:_MOST]
    figure, axes = grid(len(rows), len(channels), height_in, sharex=True)
    top_hz = min(3.5 * band_hz[1], freqs[-1]) if band_hz else None
    inside = (freqs <= (top_hz or np.inf)) & (freqs > 0)
    for panels, row in zip(axes, rows, strict=True):
        for i, panel in enumerate(panels):
            for label, (density, look) in row.spectra.items():
                if np.isfinite(density[inside, i]).all():
                    panel.plot(freqs[inside], density[inside, i], look.style, color=look.colour, label=label, lw=1.2)
            if top_hz is None:
                frequency_axis(panel, freqs, "")
            else:
                panel.set_xlim(0, top_hz)
            if row.logarithmic:
                logarithmic(panel)
            else:
                panel.set_ylim(0, _top(row, freqs >= (_ABOVE / run.sample_period_s if band_hz else 0.0), i))
            if band_hz is not None:
                panel.axvspan(*band_hz, color=Tone.GRID.light, lw=0, zorder=0.5)
        panels[0].set_ylabel(row.label)
    for panel, channel in zip(axes[0], channels, strict=True):
        panel.set_title(f"{axis_label(channel.name, '')} error, {squared(channel.unit)}/Hz")
    label_below(axes[-1])
    legend(figure, axes[-1, 0], columns)
    return figure


def _top(row: SpectraRow, inside: npt.NDArray[np.bool_], i: int) -> float | None:
    """End of a linear axis: a little above the largest of the compared densities, None where that is not known."""
    compared = [row.spectra[label][0][inside, i] for label in (row.spectra if row.compared is None else row.compared)]
    top = max((float(d.max()) for d in compared if np.isfinite(d).all()), default=0.0)
    return 1.1 * top if top > 0 else None


def band_shares(
    freqs_hz: Array, own: Array, other: Array, channels: Sequence[Channel], band_hz: Sequence[float]
) -> dict[str, float]:
    """Return the power of a density, shape (n_freqs, n), inside a band relative to another's, by channel."""
    inside = (freqs_hz >= band_hz[0]) & (freqs_hz <= band_hz[1])
    power = own[inside].sum(axis=0), other[inside].sum(axis=0)
    return {
        c.name: float(power[0][i] / power[1][i])
        for i, c in enumerate(channels)
        if power[1][i] > 0 and np.isfinite(power[0][i])
    }


def share_text(run: RunFolder, own: Array, other: Array, band_hz: Sequence[float]) -> str:
    """Return shares for a sentence: ``velocity 20 %, current 3 %``; what is measured needs no estimate and is left out."""
    shares = band_shares(run.arrays["freqs_hz"], own, other, run.states[:_MOST], band_hz)
    return ", ".join(
        f"{name} {number(100 * share, 2)} %" for name, share in shares.items() if name in run.hidden_states
    )


def share_sentence(
    run: RunFolder, spectra: Mapping[str, Array], paper: Sequence[str], pair: Sequence[str], where: str
) -> str:
    """Return what is shaded, and how much of the other's power in it the paper's Koopman observer and the deployed one leave."""
    band_hz = run.band_hz
    if band_hz is None:
        return ""
    compared = [(paper[-1], paper[0])] if len(paper) > 1 else []
    compared.append((pair[-1], paper[-1] if paper else pair[0]))
    parts = []
    for own, other in compared:
        if own != other and {own, other} <= spectra.keys():
            shares = share_text(run, spectra[own], spectra[other], band_hz)
            parts.append(f"{observer_label(own)} leaves {shares} of the power of {observer_label(other)}")
    text = " Shaded: the band around the gearbox frequency at top speed"
    text += f", where {where} " + ", and ".join(parts) if parts else ""
    return text + f". Linear scales end at the largest value above {_ABOVE / run.sample_period_s:.3g} Hz."
