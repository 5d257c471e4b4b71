"""From systems or responses of units to an uncertain set: nominal, residuals, and the remainder of the form.

Continuous systems are bounded on the unit circle that the bilinear map makes of the imaginary axis
(`weights.bilinear`), responses between their frequencies as if they were straight lines in the complex plane, without a
claim there.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DimensionError
from ..core.frequency import check_grid, log_grid
from ..core.lti import StateSpace
from ..core.small_matrices import sigma_max
from .forms import Form, check_responses, misfit
from .inputs import Options, check_candidate, check_response, read_systems
from .model import ResponseUncertainty, UncertainModel, scale_system
from .nominal import NominalChoice, choose_nominal
from .settings import SET
from .weights.bilinear import BilinearAxis, continuous_grid
from .weights.fit import Target, fit_weight
from .weights.residuals import Residuals

Array = npt.NDArray[Any]

POOLED = "pooled"  # name of a nominal that is no unit
_LOG = logging.getLogger(__name__)


def bound_systems(models: Any, form: Form, freqs_hz: npt.ArrayLike | None, options: Options) -> UncertainModel:
    """Return the set of systems, discrete or continuous."""
    system, options = read_systems(models, options)
    scales, ids = options.scales(system.D.shape[-2:]), options.ids(system.batch_shape[0])
    units, axis = scale_system(system, *scales), None
    if system.dt == 0:
        freqs = continuous_grid(system, freqs_hz)
        axis = BilinearAxis.over(freqs)
    elif freqs_hz is None:
        freqs = log_grid(system.dt, longest_s=getattr(models, "longest_s", None))
    else:
        freqs = check_grid(freqs_hz, system.dt)
    responses = units.frequency_response(freqs)
    choices = {other: choose_nominal(responses, other) for other in Form}
    if isinstance(options.nominal, StateSpace):
        check_candidate(options.nominal, system)
        index, chosen = -1, options.nominal
    else:
        index = options.row(ids, choices[form].index)
        chosen = system[index]
    base, last_hz = scale_system(chosen, *scales), np.inf
    if axis is not None:  # constant beyond the grid: there a strictly proper plant has numerically no pseudo-inverse
        base, units, last_hz = axis.discrete(base), axis.discrete(units), float(axis.discrete_hz(freqs[-1]))
    residuals = Residuals(
        form,
        lambda at_hz: base.frequency_response(np.minimum(at_hz, last_hz)),
        lambda at_hz, rows: units[rows].frequency_response(np.minimum(at_hz, last_hz)),
        np.arange(len(ids)),
        (base, units),
        proven=axis is None,
    )
    bound = _bound(residuals, freqs, axis, system.dt, options)
    return UncertainModel(nominal_system=chosen, **_fields(ids, index, freqs, scales, choices, bound))


def bound_responses(
    responses: Array, form: Form, freqs_hz: npt.ArrayLike | None, options: Options
) -> ResponseUncertainty:
    """Return the set of frequency responses, shape (unit, frequency, p, m)."""
    G, dt = check_responses(responses), float(options.sample_period_s)
    if freqs_hz is None:
        raise ConfigError("Quantify: responses need their frequencies, freqs_hz in Hz.")
    freqs = check_grid(freqs_hz, dt or None)
    if G.shape[1] != len(freqs):
        raise DimensionError(
            f"Quantify: responses at {G.shape[1]} frequencies need as many freqs_hz, found {len(freqs)}."
        )
    ids, nominal, scales = options.ids(len(G)), options.nominal, options.scales(G.shape[2:])
    given = nominal is not None and not isinstance(nominal, str) and np.ndim(nominal) > 0
    for name, value in zip((*ids, "the nominal"), [*G, np.asarray(nominal)] if given else G, strict=False):
        check_response(name, value, G.shape[1:], freqs)
    units = G / scales[0][:, None] * scales[1]
    choices = {other: choose_nominal(units, other) for other in Form}
    index = -1 if given else options.row(ids, choices[form].index)
    chosen = np.asarray(nominal) if given else G[index]
    base, axis = (chosen / scales[0][:, None] * scales[1])[None], None if dt else BilinearAxis.over(freqs)
    at = freqs if axis is None else axis.discrete_hz(freqs)
    residuals = Residuals(
        form, lambda f: _between(at, base, f)[0], lambda f, rows: _between(at, units[rows], f), np.arange(len(ids))
    )
    fields = _fields(ids, index, freqs, scales, choices, _bound(residuals, freqs, axis, dt, options))
    certificate = _certificate(freqs, fields["bounds"][form])
    return ResponseUncertainty(nominal_response=chosen, sample_period_s=dt, certificate=certificate, **fields)


def _certificate(freqs: Array, bound: Array) -> str:
    """Return where a bound of responses holds, and which of its peaks the frequencies do not resolve."""
    text = f"at the {len(freqs)} frequencies given, {freqs[0]:.6g} to {freqs[-1]:.6g} Hz; not between or beyond them"
    middle, low = bound[1:-1], np.minimum(bound[:-2], bound[2:])
    top = (middle >= bound[:-2]) & (middle >= bound[2:])
    unresolved = freqs[1:-1][top & (middle > np.maximum(SET.resolved * low, SET.exact * bound.max()))]
    if unresolved.size:
        some = ", ".join(f"{f:.4g}" for f in unresolved[:5])
        text += f"; they do not resolve {unresolved.size} peaks of the residuals, at {some} Hz"
        _LOG.warning(
            "Weights of responses: the residuals peak within less than a step of the frequencies given, at %s Hz, and "
            "may be larger beside them; measure more densely there.",
            some,
        )
    return text


def _between(freqs: Array, values: Array, at_hz: Array) -> Array:
    """Return responses (unit, frequency, p, m) at other frequencies, on straight lines, constant beyond the ends."""
    right = np.searchsorted(freqs, at_hz).clip(1, max(len(freqs) - 1, 1))
    left, right = right - 1, np.minimum(right, len(freqs) - 1)
    step = np.where(right > left, freqs[right] - freqs[left], 1.0)
    share = ((at_hz - freqs[left]) / step).clip(0.0, 1.0)[:, None, None]
    return np.asarray(values[:, left] * (1 - share) + values[:, right] * share)


def _bound(
    residuals: Residuals, freqs_hz: Array, axis: BilinearAxis | None, dt: float, options: Options
) -> dict[str, Any]:
    """Return bound, cover, weight, misfit, and cover and weight of the remainder where the form leaves one."""
    freqs = freqs_hz if axis is None else axis.discrete_hz(freqs_hz)
    target = Target(dt if axis is None else axis.period_s, options.max_order, options.tolerance_db)
    weight, cover = fit_weight(residuals, freqs, target)
    G, ratios, largest, form = residuals.nominal(freqs), [], [], residuals.form
    for rows in residuals.blocks():
        ratios.append(misfit(form, G, residuals.units(freqs, rows)))
        largest.append(sigma_max(residuals.of(rows).at(freqs)).max(axis=0))
    bound: dict[str, Any] = {"form": form, "bound": np.max(largest, axis=0), "misfit": np.concatenate(ratios)}
    bound |= {"weight": weight, "cover": cover}
    if _leaves_out(form, bound["misfit"]):
        bound["remainder"] = fit_weight(replace(residuals, remainder=True), freqs, target)[0]
    if axis is not None:
        bound |= {name: bound[name].mapped(axis.continuous) for name in ("weight", "remainder") if name in bound}
    return bound


def _leaves_out(form: Form, ratio: Array) -> bool:
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


def _fields(
    ids: tuple[str, ...],
    index: int,
    freqs_hz: Array,
    scales: tuple[Array, Array],
    choices: dict[Form, NominalChoice],
    bound: dict[str, Any],
) -> dict[str, Any]:
    """Return the fields of `Uncertainty` for the nominal `index` among the units."""
    name, form, largest = ids[index] if index >= 0 else POOLED, bound["form"], bound.pop("bound")
    return bound | {
        "unit_ids": ids,
        "nominal": index,
        "nominal_id": name,
        "freqs_hz": freqs_hz,
        "output_scale": scales[0],
        "input_scale": scales[1],
        "bounds": {f: choice.bound for f, choice in choices.items()} | {form: largest},
        "nominals": {f: ids[choice.index] for f, choice in choices.items()} | {form: name},
    }
