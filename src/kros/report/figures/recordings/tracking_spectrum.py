"""Power spectrum of the tracking error at constant speed, against multiples of the disturbance's frequency (the paper's Figure 4)."""

from __future__ import annotations

import numpy as np

from ....evaluate.errors import error_spectrum
from ...canvas import Array, Figure, grid, legend, logarithmic, note
from ...names import episode_title, squared
from ...run_folder import NotShownError, RunFolder, Shown
from ...theme import Tone
from ..episodes import recorded_episodes, steady_stretches

_SEGMENT = 1024


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw the spectrum for one episode of every condition."""
    spec = run.calibration.spec
    figure, axes = grid(1, 1, 2.3)
    frequency = 0.0
    for shown, tone in zip(recorded_episodes(run), (Tone.BLUE, Tone.GOLD, Tone.GREEN), strict=False):
        freqs, density, frequency = _spectrum(run, shown)
        axes[0, 0].plot(freqs[1:], density[1:], color=tone.light, label=episode_title(shown.key))
    logarithmic(axes[0, 0])
    top = 0.5 / run.sample_period_s
    for multiple in range(1, min(6, int(top / frequency)) + 1):
        axes[0, 0].axvline(multiple * frequency, color=Tone.SOFT.light, lw=0.7, ls=":", zorder=1)
        note(
            axes[0, 0],
            f"{multiple * frequency:.0f} Hz",
            (multiple * frequency, 1),
            (3, -2),
            xycoords=("data", "axes fraction"),
            va="top",
        )
    axes[0, 0].set_xlim(0, min(top, 6.6 * frequency))
    axes[0, 0].set_xlabel("frequency (Hz)")
    unit = next(c.unit for c in run.channels if c.name == spec.measured)
    axes[0, 0].set_ylabel(f"{spec.measured} error,\nPSD ({squared(unit)}/Hz)")
    legend(figure, axes[0, 0])
    return figure, (
        f"Power spectral density of {spec.reference.replace('_', ' ')} minus {spec.measured} at the highest speed. The gearbox puts its peaks at "
        f"{frequency:.3g} Hz, where {spec.ratio:g} times the speed lies, and at multiples; the lifting models the first."
    )


def _spectrum(run: RunFolder, shown: Shown) -> tuple[Array, Array, float]:
    spec = run.calibration.spec
    names = [c.name for c in run.channels]
    values = np.hstack([shown.states, shown.inputs]).astype(float)
    reference, measured = values[:, names.index(spec.reference)], values[:, names.index(spec.measured)]
    settle = round(spec.settle * len(reference))
    stretches = [slice(a + settle, b) for a, b in steady_stretches(reference)]
    longest = max((s.stop - s.start for s in stretches), default=0)
    segment = min(_SEGMENT, longest)
    if segment < 64:
        raise NotShownError(f"{shown.key} has no stretch of constant speed that is long enough")
    used = [s for s in stretches if s.stop - s.start >= segment]
    found = [error_spectrum((reference - measured)[s], run.sample_period_s, segment) for s in used]
    weights = [s.stop - s.start for s in used]
    return (
        found[0][0],
        np.average([d for _, d in found], axis=0, weights=weights),
        spec.ratio * float(np.abs(reference).max()) / (2 * np.pi),
    )
