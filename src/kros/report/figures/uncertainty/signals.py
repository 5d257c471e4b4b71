"""The set of signals: what single steps of recorded machines leave of a model, over frequency, and the cover of all units."""

from __future__ import annotations

import numpy as np

from ....data import EpisodeBatch
from ....data.survey import RecordingFacts
from ....observer import Observer
from ....observer.residual.one_step import one_step_residual
from ....uncertainty.coprime.signals import SignalSet
from ...canvas import Array, Axes, Figure, frequency_axis, grid, legend, lines_of_units, logarithmic
from ...names import best_models, model_label
from ...run_folder import NotShownError, RunFolder
from ...theme import Tone

_SECONDS, _METHOD, _MOST = 5.0, "worst_case_h2", 24


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw a row for every hidden state, of the Koopman model where it has a worst-case observer."""
    names = best_models(name for name in run.models if f"{name}/{_METHOD}" in run.observers_record["names"])[-1:]
    if not names:
        raise NotShownError("no worst-case H2 observer was designed, for whose model the residuals would be shown")
    hidden, states = run.hidden_states, [c.name for c in run.states]
    figure, axes = grid(len(hidden), len(names), 2.0, sharex=True, sharey="row")
    for column, name in enumerate(names):
        batch = _episodes(run, name)
        own = Observer.load(run.folder / "observers" / f"{name}/{_METHOD}.json")
        models = run.models[name]
        row = models.index(run.uncertain[name].nominal_id)
        nominal, chosen = (_signals(own, A, B, batch) for A, B in ((models.A[row], models.B[row]), (own.A, own.B)))
        freqs, dt = _centres(chosen, batch.sample_period_s), batch.sample_period_s
        for panel, state in zip(axes[:, column], hidden, strict=True):
            i = states.index(state)
            size = models.output_scale[i]
            lines_of_units(panel, freqs, _density(chosen, chosen.energies.energy, i, dt) / size, Tone.BLUE.light, "units", chosen.unit_ids)
            panel.plot(freqs, _density(chosen, chosen.cover.energy, i, dt) / size, color=Tone.INK.light, lw=1.8, label="cover")
            unit = _density(nominal, nominal.cover.energy, i, dt) / size
            panel.plot(freqs, unit, "--", color=Tone.ORANGE.light, lw=1.2, label="cover, model of the nominal unit")
            _finish(panel, freqs)
            panel.set_ylabel(state if not column else "")
        axes[0, column].set_title(model_label(name))
    legend(figure, axes[0, 0])
    text = (
        "Residuals of single steps along recorded motion, which drive an observer's error, of the model that the worst-case H2 observer runs: root of the "
        "power density, as a share of the state's range. Thick: the cover that the set of signals is made of. Dashed: the cover for the nominal unit's model; "
        "a nominal is chosen by the error that its observer is certified for, not by the height of such a line."
    )
    return figure, text


def _episodes(run: RunFolder, kind: str) -> EpisodeBatch:
    facts, models = RecordingFacts.load(run.folder / "population"), run.models[kind]
    units = [u for u in facts.pooled if u in models.unit_ids][:_MOST]
    keys = [key for u in units for key in facts.keys("train", u, facts.identify_on)[:1]]
    rows = {u: {name: float(values[models.index(u)]) for name, values in models.parameters.items()} for u in units}
    return EpisodeBatch.read(run.population.select(units), keys, round(_SECONDS / run.population.sample_period_s), rows)


def _signals(observer: Observer, A: Array, B: Array, batch: EpisodeBatch) -> SignalSet:
    residual = one_step_residual(observer.lifting, A, B, batch.states, batch.inputs, observer.own(batch.parameters))
    return SignalSet.of(residual, batch.lengths - 1 - observer.lifting.history, batch.units)


def _centres(signals: SignalSet, dt: float) -> Array:
    edges = signals.energies.edges
    return np.asarray(np.sqrt(np.maximum(edges[:-1], edges[1] / 2) * edges[1:]) / (2 * np.pi * dt))


def _density(signals: SignalSet, energy: Array, state: int, dt: float) -> Array:
    width = np.diff(signals.energies.edges) / (2 * np.pi * dt)
    return np.asarray(np.sqrt(np.maximum(energy[..., state, state].real, 0.0) / width))


def _finish(panel: Axes, freqs: Array) -> None:
    logarithmic(panel)
    frequency_axis(panel, freqs)
