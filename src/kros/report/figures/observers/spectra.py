"""Spectra of the estimation errors of the paper's pair of observers and of the deployed pair (the paper's Figure 12)."""

from __future__ import annotations

from ...canvas import Figure
from ...names import deployed_pair, paper_pair
from ...run_folder import RunFolder
from ..spectra import observer_row, of_episode, share_sentence, spectra_figure
from .in_time import kept_episodes


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw nominal and worst off-nominal unit on linear scales, pair by pair, and the mean over all other units on a logarithmic one."""
    shown = kept_episodes(run)
    names, paper = deployed_pair(list(shown[0].observers), run.deployed), paper_pair(shown[0].observers)
    pairs = [(pair, whose) for pair, whose in ((paper, "the paper's"), (names, "deployed")) if pair]
    rows = [
        observer_row(f"{where},\n{whose}", of_episode(run, episode, pair))
        for pair, whose in (pairs[:1] if names == paper else pairs)
        for episode, where in zip(shown, ("nominal", "worst off-nom."), strict=False)
    ]
    keys = {n: f"spectrum/off_nominal/{run.identify_on}/{n}" for n in dict.fromkeys([*paper, *names])}
    others = {n: run.arrays[key] for n, key in keys.items() if key in run.arrays}
    if others:
        rows.append(observer_row("all others,\nlog scale", others, logarithmic=True))
    text = "Power spectral densities of the estimation errors: the episode that is shown above of the nominal and of the worst off-nominal unit, "
    text += "and the mean over all units but the nominal one."
    return spectra_figure(run, rows, 1.2, columns=2), text + share_sentence(run, others, paper, names, "off nominal")
