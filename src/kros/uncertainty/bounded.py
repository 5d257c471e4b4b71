"""From systems or responses of units to an uncertain set: nominal, residuals, and the remainder of the form.

Responses are bounded between their frequencies as if they were straight lines in the complex plane, without a claim
there.

Choice of the nominal: the unit from which all others differ the least (section IV-C).
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np

from ..core.arrays import AnyArray, ArrayLike, frozen
from ..core.errors import ConfigError
from ..core.frequency import check_grid, log_grid
from ..core.linalg import sigma_max
from ..core.lti import StateSpace
from ..identify.refine.metric import smallest_largest
from .forms import Form, as_form, check_responses, misfit, residual
from .inputs import Options, read_systems
from .model import ResponseUncertainty, UncertainModel, scale_system
from .settings import SET
from .weights.fit import Residuals, Sampled, fit_weight


@frozen
class NominalChoice:
    """Best nominal of one form."""

    index: int  # row of the chosen unit
    bound: AnyArray  # (frequency,): largest residual over the other units


def choose_nominal(responses: ArrayLike, form: Form | str) -> NominalChoice:
    """Return the unit with the lowest peak residual against all others; exact, and without visiting all pairs of units.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In scaled coordinates; only pooled units.
    form : Form or str

    Returns
    -------
    NominalChoice
        With ``index``, the row of the unit, and ``bound``, the largest residual over the others, shape (frequency,).

    Raises
    ------
    ConfigError
        When the form is unknown.
    DimensionError
        When responses do not have these axes.
    DataError
        When one is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import choose_nominal
    >>> gains = np.array([1.0, 2.0, 9.0]).reshape(3, 1, 1, 1) + 0j
    >>> choice = choose_nominal(gains, "additive")
    >>> choice.index, choice.bound.tolist()
    (1, [7.0])
    """
    form, G = as_form(form), check_responses(responses)
    every = np.arange(G.shape[1])

    def size(nominal: AnyArray, perturbed: AnyArray) -> AnyArray:
        return sigma_max(residual(form, G[nominal, every], G[perturbed, every]))

    return NominalChoice(*smallest_largest((len(G), len(every)), size))


_LOG = logging.getLogger(__name__)


def bound_systems(models: Any, form: Form, freqs_hz: ArrayLike | None, options: Options) -> UncertainModel:
    """Return the set of systems."""
    system, options = read_systems(models, options)
    scales, ids = options.scales(system.D.shape[-2:]), options.ids(system.batch_shape[0])
    units = scale_system(system, *scales)
    grid = log_grid(system.dt, longest_s=getattr(models, "longest_s", None)) if freqs_hz is None else freqs_hz
    freqs = check_grid(grid, system.dt)
    fields = _bound(form, units, freqs, system.dt, ids, options)
    nominal = system[fields["nominal"]]
    return UncertainModel(nominal_system=nominal, output_scale=scales[0], input_scale=scales[1], **fields)


def bound_responses(
    responses: AnyArray, form: Form, freqs_hz: ArrayLike | None, options: Options
) -> ResponseUncertainty:
    """Return the set of frequency responses, shape (unit, frequency, p, m)."""
    dt, ids = options.sample_period_s, options.ids(len(responses))
    if freqs_hz is None or dt is None:
        raise ConfigError("Quantify: responses need their frequencies, freqs_hz in Hz, and sample_period_s in seconds.")
    freqs = check_grid(freqs_hz, float(dt))
    G = check_responses(responses, ids, freqs)
    scales = options.scales(G.shape[2:])
    units = Sampled(freqs, G / scales[0][:, None] * scales[1])
    fields = _bound(form, units, freqs, float(dt), ids, options)
    fields |= {"output_scale": scales[0], "input_scale": scales[1], "sample_period_s": float(dt)}
    certificate = _certificate(freqs, fields["bounds"][form])
    return ResponseUncertainty(nominal_response=G[fields["nominal"]], certificate=certificate, **fields)


def _certificate(freqs: AnyArray, bound: AnyArray) -> str:
    """Return where a bound of responses holds, and which of its peaks the frequencies do not resolve."""
    text = f"at the {len(freqs)} frequencies given, {freqs[0]:.6g} to {freqs[-1]:.6g} Hz; not between or beyond them"
    middle, low = bound[1:-1], np.minimum(bound[:-2], bound[2:])
    top = (middle >= bound[:-2]) & (middle >= bound[2:])
    unresolved = freqs[1:-1][top & (middle > np.maximum(SET.resolved * low, SET.exact * bound.max()))]
    if unresolved.size:
        some = ", ".join(f"{f:.4g}" for f in unresolved[:5])
        text += f"; they do not resolve {unresolved.size} peaks of the residuals, at {some} Hz"
        _LOG.warning("Weights of responses: residuals peak between frequencies, at %s Hz; measure more densely.", some)
    return text


def _bound(
    form: Form, units: StateSpace | Sampled, freqs: AnyArray, dt: float, ids: tuple[str, ...], options: Options
) -> dict[str, Any]:
    """Return the set around the best nominal or that of the options, with the remainder where the form leaves one."""
    responses = units.frequency_response(freqs)
    choices = {form: choose_nominal(responses, form) for form in Form}
    index, target = options.row(ids, choices[form].index), (dt, options.max_order, options.tolerance_db)
    residuals, G = Residuals(form, units[index], units, len(ids)), responses[index]
    weight, cover = fit_weight(residuals, freqs, *target)
    ratios, largest = zip(*((misfit(form, G, Gp), sigma_max(E)) for Gp, E in residuals.pieces(freqs)), strict=True)
    ratio, bound = np.concatenate(ratios), np.concatenate(largest).max(axis=0)
    fields = {
        "form": form,
        "unit_ids": ids,
        "nominal": index,
        "nominal_id": ids[index],
        "freqs_hz": freqs,
        "misfit": ratio,
    }
    fields["bounds"] = {f: choice.bound for f, choice in choices.items()} | {form: bound}
    fields["nominals"] = {f: ids[choice.index] for f, choice in choices.items()} | {form: ids[index]}
    remainder = fit_weight(replace(residuals, remainder=True), freqs, *target)[0] if _leaves_out(form, ratio) else None
    return fields | {"cover": cover, "weight": weight, "remainder": remainder}


def _leaves_out(form: Form, ratio: AnyArray) -> bool:
    """Tell whether an additive remainder is needed, and warn."""
    unknown = int(np.isnan(ratio).sum())
    if unknown:
        text = "Uncertainty form %s: near singular for %d of %d units and frequencies; the misfit is unknown there."
        _LOG.warning(text, form.value, unknown, ratio.size)
    largest = np.nanmax(ratio) if unknown < ratio.size else np.inf
    if largest <= SET.exact and not unknown:
        return False
    text = "Uncertainty form %s cannot represent up to %.3g %% of a unit's response, which an additive term covers."
    level = logging.WARNING if largest > SET.warned else logging.INFO
    _LOG.log(level, f"{text} The additive form needs none.", form.value, 100 * largest)
    return True
