"""Spectra of the estimation errors of the nominal unit in a condition that no model has seen (the paper's Figure 14)."""

from __future__ import annotations

from ...canvas import Figure
from ...names import condition_label, deployed_pair, paper_pair
from ...run_folder import RunFolder
from ..spectra import observer_row, of_episode, share_sentence, spectra_figure
from .other_condition import other_episode


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw the paper's pair and the deployed pair on linear scales, and all of them on a logarithmic one."""
    shown = other_episode(run)
    names, paper = deployed_pair(list(shown.observers), run.deployed), paper_pair(shown.observers)
    spectra = of_episode(run, shown, list(dict.fromkeys([*paper, *names])))
    pairs = [("the paper's", paper)] if paper else []
    pairs += [("deployed", names)] if names != paper else []
    rows = [observer_row(f"{whose},\nlinear scale", {n: spectra[n] for n in pair}) for whose, pair in pairs]
    rows.append(observer_row("all of them,\nlog scale", spectra, logarithmic=True))
    text = f"Power spectral densities of the errors in the episode above ({condition_label(shown.key.condition)})."
    return spectra_figure(run, rows, 1.3, columns=2), text + share_sentence(
        run, spectra, paper, names, "in this episode"
    )
