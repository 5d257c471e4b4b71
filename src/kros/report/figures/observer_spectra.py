"""Spectra of the estimation errors of the paper's pair of observers and of the pair that is handed over (the paper's Figure 12).

Needs: the evaluation's kept episodes with observers, and its observer spectra.
"""

from __future__ import annotations

from ..canvas import grid, legend
from ..names import deployed_pair, paper_pair
from ..run_folder import RunFolder
from .drawing import Drawing
from .error_spectra import SpectraRow, draw_rows, of_episode, of_role, share_sentence
from .observers_in_time import episodes
from .trajectories import states

NAME, TITLE = "observer_spectra", "Spectra of the estimation errors"


def draw(run: RunFolder) -> Drawing:
    """Draw nominal and worst off-nominal unit on linear scales, pair by pair, and the mean over all other units on a logarithmic one."""
    shown = episodes(run)
    names, paper = deployed_pair(list(shown[0].observers), run.deployed), paper_pair(shown[0].observers)
    rows = [
        SpectraRow(f"{where},\n{whose}", of_episode(run, episode, pair))
        for pair, whose in ((paper, "the paper's"), (names, "handed over"))
        for episode, where in zip(shown, ("nominal", "worst off-nom."), strict=False)
        if pair and (whose == "the paper's" or pair != paper)
    ]
    everyone = list(dict.fromkeys([*paper, *names]))
    others = of_role(run, "off_nominal", run.identify_on, everyone)
    if others:
        rows.append(SpectraRow("all others,\nlog scale", others, logarithmic=True))
    figure, axes = grid(len(rows), len(states(run)[:4]), 1.2, legend_rows=2, sharex=True)
    draw_rows(run, axes, rows)
    legend(figure, axes[-1, 0], columns=2)
    text = "Power spectral densities of the estimation errors: the episode that is shown above of the nominal and of the worst off-nominal unit, "
    text += "and the mean over all units but the nominal one."
    return Drawing(figure, text + share_sentence(run, others, paper, names, "off nominal"))
