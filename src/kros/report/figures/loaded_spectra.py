"""Spectra of the estimation errors of the nominal unit in a condition that no model has seen (the paper's Figure 14).

Needs: the evaluation's kept episodes in a second condition.
"""

from __future__ import annotations

from ..canvas import grid, legend
from ..names import condition_label, deployed_pair, paper_pair
from ..run_folder import RunFolder
from .drawing import Drawing
from .error_spectra import SpectraRow, draw_rows, of_episode, share_sentence
from .loaded import loaded_episode
from .trajectories import states

NAME, TITLE = "loaded_spectra", "Spectra of the errors in the other condition"


def draw(run: RunFolder) -> Drawing:
    """Draw the paper's pair and the pair that is handed over on linear scales, and all of them on a logarithmic one."""
    shown = loaded_episode(run)
    names, paper = deployed_pair(list(shown.observers), run.deployed), paper_pair(shown.observers)
    spectra = of_episode(run, shown, list(dict.fromkeys([*paper, *names])))
    pairs = [("the paper's", paper)] if paper else []
    pairs += [("handed over", names)] if names != paper else []
    rows = [SpectraRow(f"{whose},\nlinear scale", {n: spectra[n] for n in pair}) for whose, pair in pairs]
    rows.append(SpectraRow("all of them,\nlog scale", spectra, logarithmic=True))
    figure, axes = grid(len(rows), len(states(run)[:4]), 1.3, legend_rows=2, sharex=True)
    draw_rows(run, axes, rows)
    legend(figure, axes[-1, 0], columns=2)
    text = f"Power spectral densities of the errors in the episode above ({condition_label(shown.key.condition)})."
    return Drawing(figure, text + share_sentence(run, spectra, paper, names, "in this episode"))
