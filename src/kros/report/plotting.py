"""Plots of results in memory: one verb, the figure that suits the result."""

from __future__ import annotations

from functools import singledispatch
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import ConfigError
from ..data.population import Population
from ..identify import ModelSet, PhaseCalibration
from ..synthesis.result import Synthesis
from ..uncertainty import OutlierModel, Tightness, UncertainModel, VariationAndNoise
from .canvas import decibel, frequency_axis, grid
from .figures.bode import bode_figure
from .figures.outlier_scores import scores_figure
from .figures.phase import phase_figure
from .figures.trajectories import label_rows
from .figures.uncertain_model import uncertain_figure
from .figures.variation import variation_figure
from .figures.weight_orders import orders_figure
from .names import Look, method_label, number
from .theme import Tone, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot(result: Any, **options: Any) -> Figure:
    """Return a figure of a result.

    Parameters
    ----------
    result : Population, PhaseCalibration, ModelSet, UncertainModel, VariationAndNoise, Tightness, OutlierModel or Synthesis
        A population is shown by the first episode of its first unit.
    **options
        Of an uncertain model ``version``, ``"sound"`` (largest singular values, weights and cover) or ``"entrywise"`` (the paper's figures), and
        ``models``, the `ModelSet` behind it, which shows every unit and which entries need. Of models ``nominal``, a unit that is drawn on top.

    Returns
    -------
    matplotlib.figure.Figure
        Not known to pyplot; notebooks show it, `figure.savefig(...)` writes it.

    Raises
    ------
    ConfigError
        For anything else, and for options that the result does not have.

    Examples
    --------
    >>> from kros.core.lti import gain
    >>> from kros.report import plot
    >>> from kros.synthesis import Status, Synthesis
    >>> figure = plot(Synthesis("h2", gain([[0.5]], 0.01), Status.OPTIMAL, h2_norm=1.2))
    >>> len(figure.axes)
    2
    """
    draw = _draw.dispatch(type(result))
    known = list(signature(draw).parameters)[1:]
    unknown = sorted(set(options) - set(known))
    if unknown and draw is not _draw.dispatch(object):
        raise ConfigError(
            f"Plot: a {type(result).__name__} has no option {', '.join(map(repr, unknown))}; it has {', '.join(known) or 'none'}."
        )
    return draw(result, **options)


@singledispatch
def _draw(result: Any, **_: Any) -> Figure:
    raise ConfigError(
        f"Plot: found a {type(result).__name__}; give a Population, PhaseCalibration, ModelSet, UncertainModel, VariationAndNoise, Tightness, OutlierModel "
        "or Synthesis, or render a run folder."
    )


@_draw.register(Population)
@styled
def _population(result: Population) -> Figure:
    if not result.episodes:
        raise ConfigError("Plot: the population has no episodes; read some first.")
    key = result.episodes[0]
    values = result.read(key)
    figure, axes = grid(len(result.channels), 1, 1.1, legend_rows=1, sharex=True)
    time_s = np.arange(len(values)) * result.sample_period_s
    for panel, channel, line in zip(axes[:, 0], result.channels, values.T, strict=True):
        panel.plot(time_s, line, color=Look(Tone.INK.light if channel.name in result.states else Tone.GOLD.light).colour, lw=1.0)
    label_rows(axes[:, 0], result.channels)
    axes[-1, 0].set_xlabel("time (s)")
    figure.suptitle(f"{key}", x=0.01, ha="left", size=9, weight="bold")
    return figure


_draw.register(PhaseCalibration, styled(phase_figure))
_draw.register(ModelSet, styled(bode_figure))
_draw.register(UncertainModel, styled(uncertain_figure))


@_draw.register(VariationAndNoise)
@styled
def _variation(result: VariationAndNoise) -> Figure:
    return variation_figure({"": result})


@_draw.register(Tightness)
@styled
def _order(result: Tightness) -> Figure:
    return orders_figure({"": result})


@_draw.register(OutlierModel)
@styled
def _scores(result: OutlierModel) -> Figure:
    return scores_figure({"": result})


@_draw.register(Synthesis)
@styled
def _synthesis(result: Synthesis) -> Figure:
    figure, axes = grid(1, 2, 2.6, legend_rows=0, width_ratios=(1.6, 1))
    _magnitudes(axes[0, 0], result)
    _numbers(axes[0, 1], result)
    return figure


def _magnitudes(axes: Axes, result: Synthesis) -> None:
    K = result.controller
    freqs = np.geomspace(1e-5, 1, 300) * (0.5 / K.dt if K.dt else 1e3)
    response = K.frequency_response(freqs)
    for (i, j), tone in zip(np.ndindex(*response.shape[1:]), list(Tone) * response[0].size, strict=False):
        axes.plot(freqs, decibel(response[:, i, j]), color=tone.light, label=f"K{i + 1}{j + 1}")
    frequency_axis(axes, freqs)
    axes.set_ylabel("|K| (dB)")
    axes.set_title(f"correction filter, {method_label(result.method)}")
    axes.legend(ncols=2)


def _numbers(axes: Axes, result: Synthesis) -> None:
    """What is certified, as a list."""
    axes.axis("off")
    axes.set_title("certificate")
    facts = {
        "status": result.status.value,
        "filter states": str(result.controller.n_states),
        "H2 norm": number(result.h2_norm, 4),
        "H∞ norm": number(result.hinf_norm, 4),
        "worst-case H2": number(result.worst_case_h2, 4),
        "lower bound": number(result.lower_bound, 4),
        "gap (%)": number(result.gap_percent),
        "spectral radius": number(result.spectral_radius, 6),
    }
    for row, (name, value) in enumerate(facts.items()):
        axes.annotate(name, (0, 0.95 - 0.12 * row), xycoords="axes fraction", va="top", color=Tone.SOFT.light)
        axes.annotate(value, (0.62, 0.95 - 0.12 * row), xycoords="axes fraction", va="top")
