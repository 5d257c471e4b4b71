"""Shared by the figures of observers' error spectra: rows of linear or logarithmic scale, a column a state, the gearbox band marked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...evaluate.errors import error_spectrum
from ..names import observer_label, observer_look, split_observer
from ..run_folder import RunFolder, Shown
from .spectra import band, band_shares, density_label, draw_spectra, robust_top, share_text
from .trajectories import states

Array = npt.NDArray[Any]
_ABOVE_HZ = 10.0  # offsets below would flatten the rest of a linear scale


@dataclass(frozen=True, eq=False)
class SpectraRow:
    """One row of axes: what it is called, and by observer a density of shape (n_freqs, n)."""

    label: str
    spectra: Mapping[str, Array]
    logarithmic: bool = False


def of_episode(run: RunFolder, shown: Shown, names: Sequence[str]) -> dict[str, Array]:
    """Return the spectra of the errors in one kept episode, by observer."""
    with np.errstate(over="ignore", invalid="ignore"):
        return {n: error_spectrum(shown.observers[n].astype(float) - shown.states, run.sample_period_s)[1] for n in names}


def of_role(run: RunFolder, role: str, condition: str, names: Sequence[str]) -> dict[str, Array]:
    """Return the mean spectra over units of a role, by observer; empty where there is no such unit."""
    keys = {n: f"spectrum/{role}/{condition}/{n}" for n in names}
    return {n: run.arrays[key] for n, key in keys.items() if key in run.arrays}


def draw_rows(run: RunFolder, axes: npt.NDArray[Any], rows: Sequence[SpectraRow]) -> None:
    """Draw rows of spectra into a grid, with titles, labels and the gearbox band."""
    freqs, band_hz = run.arrays["freqs_hz"], run.evaluation.get("band_hz")
    top = min(3.5 * band_hz[1], freqs[-1]) if band_hz else None
    for panels, row in zip(axes, rows, strict=True):
        draw_spectra(panels, freqs, {observer_label(n): (d, observer_look(n)) for n, d in row.spectra.items()}, row.logarithmic, top)
        if not row.logarithmic:
            compared = [d for n, d in row.spectra.items() if split_observer(n)[1] != "open_loop"]
            robust_top(panels, freqs, compared, _ABOVE_HZ if band_hz else 0.0)
        for panel in panels:
            band(panel, band_hz)
        panels[0].set_ylabel(row.label)
    for i, channel in enumerate(states(run)[: axes.shape[1]]):
        axes[0, i].set_title(density_label(channel))
        axes[-1, i].set_xlabel("frequency (Hz)")


def share_sentence(run: RunFolder, spectra: Mapping[str, Array], paper: Sequence[str], pair: Sequence[str], where: str) -> str:
    """Return what is shaded, and how much of the other's power in it the paper's Koopman observer and the one that is handed over leave."""
    band_hz = run.evaluation.get("band_hz")
    if band_hz is None:
        return ""
    compared = [(paper[-1], paper[0])] if len(paper) > 1 else []
    compared.append((pair[-1], paper[-1] if paper else pair[0]))
    parts = []
    for own, other in compared:
        if own != other and {own, other} <= spectra.keys():
            shares = band_shares(run.arrays["freqs_hz"], spectra[own], spectra[other], states(run)[:4], band_hz)
            parts.append(f"{observer_label(own)} leaves {share_text(shares, states(run))} of the power of {observer_label(other)}")
    text = " Shaded: the band around the gearbox frequency at top speed"
    text += f", where {where} " + ", and ".join(parts) if parts else ""
    return text + f". Linear scales end at the largest value above {_ABOVE_HZ:g} Hz."
