"""Spectra of the estimation errors of the main observers (the paper's Figure 12).

Needs: the evaluation's observer spectra.
"""

from __future__ import annotations

from ..canvas import grid, legend
from ..names import is_koopman, main_observers, observer_label, observer_look, split_observer
from ..run_folder import NotShownError, RunFolder
from .drawing import Drawing
from .spectra import band, band_shares, density_label, draw_spectra, robust_top, share_text
from .trajectories import states

NAME, TITLE = "observer_spectra", "Spectra of the estimation errors"
_ROWS = (
    ("nominal", False, "nominal,\nlinear scale"),
    ("off_nominal", False, "off nominal,\nlinear scale"),
    ("off_nominal", True, "off nominal,\nlog scale"),
)


def draw(run: RunFolder) -> Drawing:
    """Draw mean spectra of the nominal unit and of all others."""
    condition = run.identify_on
    rows = [row for row in _ROWS if any(f"spectrum/{row[0]}/{condition}/{n}" in run.arrays for n in run.evaluation["observers"])]
    if not rows:
        raise NotShownError("no observer was run on held-out episodes")
    freqs, channels, band_hz = run.arrays["freqs_hz"], states(run)[:4], run.evaluation.get("band_hz")
    names = main_observers(run.evaluation["observers"], run.deployed)
    figure, axes = grid(len(rows), len(channels), 1.35, legend_rows=2, sharex=True)
    top = min(3.5 * band_hz[1], freqs[-1]) if band_hz else None
    for row, (role, logarithmic, label) in zip(axes, rows, strict=True):
        spectra = {observer_label(n): (run.arrays[f"spectrum/{role}/{condition}/{n}"], observer_look(n)) for n in names}
        draw_spectra(row, freqs, spectra, logarithmic, top)
        if not logarithmic:
            compared = [run.arrays[f"spectrum/{role}/{condition}/{n}"] for n in names if split_observer(n)[1] != "open_loop"]
            robust_top(row, freqs, compared, 10.0 if band_hz else 0.0)
        for panel in row:
            band(panel, band_hz)
        row[0].set_ylabel(label)
    for i, channel in enumerate(channels):
        axes[0, i].set_title(density_label(channel))
        axes[-1, i].set_xlabel("frequency (Hz)")
    legend(figure, axes[0, 0], columns=2)
    text = "Power spectral densities of the estimation errors: nominal unit, and the mean over all other units."
    if band_hz:
        text += f" Shaded: the band around the gearbox frequency at top speed{_compared(run, names, rows[-1][0])}."
        text += " Linear scales end at the largest value above 10 Hz."
    return Drawing(figure, text)


def _compared(run: RunFolder, names: list[str], role: str) -> str:
    """How much of the linear twin's power in the band the observer that is handed over leaves."""
    own, twin = names[-1], names[0]
    if own == twin or is_koopman(own) == is_koopman(twin):
        return ""
    first, second = (run.arrays[f"spectrum/{role}/{run.identify_on}/{n}"] for n in (own, twin))
    shares = band_shares(run.arrays["freqs_hz"], first, second, states(run)[:4], run.evaluation["band_hz"])
    return f", where off nominal {observer_label(own)} leaves, relative to {observer_label(twin)}, this much power: {share_text(shares, states(run))}"
