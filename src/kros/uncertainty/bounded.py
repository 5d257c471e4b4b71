"""From systems or responses of units to an uncertain set: nominal, residuals, and the remainder of the form.

Continuous systems are bounded on the unit circle that the bilinear map makes of the imaginary axis
(`weights.bilinear`), responses between their frequencies as if they were straight lines in the complex plane, without a
claim there.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DimensionError
from ..core.frequency import check_grid, log_grid
from ..core.lti import StateSpace
from ..core.small_matrices import sigma_max
from .forms import Form, check_responses, misfit
from .inputs import check_candidate, check_ids, check_response, check_scales, find_nominal, read_systems
from .model import ResponseUncertainty, UncertainModel, scale_system
from .nominal import choose_nominal
from .settings import SET, FitSettings
from .weights.bilinear import BilinearAxis, beyond, continuous_grid
from .weights.fit import Target, fit_weight
from .weights.residuals import Residuals

Array = npt.NDArray[Any]

POOLED = "pooled"  # name of a nominal that is no unit
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `quantify` for systems and responses, described there."""

    unit_ids: Sequence[str] | None = None
    output_scale: npt.ArrayLike | None = None
    input_scale: npt.ArrayLike | None = None
    nominal: Any = None
    max_order: int = 4
    tolerance_db: float = 1.0
    sample_period_s: float = 0.0
    fit: FitSettings = field(default_factory=FitSettings)

    @classmethod
    def of(cls, options: dict[str, Any]) -> Options:
        """Check options by name, order and tolerance."""
        unknown = sorted(set(options) - set(cls.__dataclass_fields__))
        if unknown:
            raise ConfigError(f"Quantify: unknown {', '.join(unknown)}; known: {', '.join(cls.__dataclass_fields__)}.")
        read = cls(**options)
        if not (isinstance(read.max_order, int | np.integer) and read.max_order >= 0 and read.tolerance_db >= 0):
            raise ConfigError(
                f"Quantify: max_order = {read.max_order!r} should be a whole number from 0, tolerance_db = "
                f"{read.tolerance_db} not negative."
            )
        return read


def bound_systems(models: Any, form: Form, freqs_hz: npt.ArrayLike | None, options: Options) -> UncertainModel:
    """Return the set of systems, discrete or continuous."""
    system, ids, scales = read_systems(models, options.unit_ids, options.output_scale, options.input_scale)
    freqs, axis = _axis(system, freqs_hz, getattr(models, "longest_s", None))
    units = scale_system(system, *scales)
    responses = units.frequency_response(freqs)
    choices = {other: choose_nominal(responses, other) for other in Form}
    if isinstance(options.nominal, StateSpace):
        check_candidate(options.nominal, system)
        index, chosen = -1, options.nominal
    else:
        index = find_nominal(options.nominal, ids, choices[form].index)
        chosen = system[index]
    base = scale_system(chosen, *scales)

    def units_at(at_hz: Array, rows: Array) -> Array:
        return units[rows].frequency_response(at_hz)

    residuals = Residuals(form, base.frequency_response, units_at, np.arange(len(ids)), (base, units))
    bound = _bound(residuals, freqs, axis or system.dt, options)
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
    ids, nominal = check_ids(options.unit_ids, len(G)), options.nominal
    given = nominal is not None and not isinstance(nominal, str) and np.ndim(nominal) > 0
    for name, value in zip((*ids, "the nominal"), [*G, np.asarray(nominal)] if given else G, strict=False):
        check_response(name, value, G.shape[1:], freqs)
    scales = check_scales(options.output_scale, options.input_scale, G.shape[2:])
    units = G / scales[0][:, None] * scales[1]
    choices = {other: choose_nominal(units, other) for other in Form}
    index = -1 if given else find_nominal(nominal, ids, choices[form].index)
    chosen = np.asarray(nominal) if given else G[index]
    base = chosen / scales[0][:, None] * scales[1]

    def units_at(at_hz: Array, rows: Array) -> Array:
        return _between(freqs, units[rows], at_hz)

    residuals = Residuals(form, lambda at_hz: _between(freqs, base[None], at_hz)[0], units_at, np.arange(len(ids)))
    bound = _bound(residuals, freqs, dt or BilinearAxis.over(freqs), options)
    fields = _fields(ids, index, freqs, scales, choices, bound)
    fields["certificate"], fields["unresolved_hz"] = _certificate(freqs, fields["bounds"][form])
    return ResponseUncertainty(nominal_response=chosen, sample_period_s=dt, **fields)


def _certificate(freqs: Array, bound: Array) -> tuple[str, Array]:
    """Return where a bound of responses holds, in words, and the frequencies of peaks that are not resolved."""
    text = f"at the {len(freqs)} frequencies given, {freqs[0]:.6g} to {freqs[-1]:.6g} Hz; not between or beyond them"
    middle, low = bound[1:-1], np.minimum(bound[:-2], bound[2:])
    top = (middle >= bound[:-2]) & (middle >= bound[2:])
    unresolved = freqs[1:-1][top & (middle > np.maximum(SET.resolved * low, SET.negligible * bound.max()))]
    if unresolved.size:
        some = ", ".join(f"{f:.4g}" for f in unresolved[:5])
        text += f"; they do not resolve {unresolved.size} peaks of the residuals, at {some} Hz"
        _LOG.warning(
            "Weights of responses: the residuals peak within less than a step of the frequencies given, at %s Hz, and "
            "may be larger beside them; measure more densely there.",
            some,
        )
    return text, unresolved


def _axis(
    system: StateSpace, freqs_hz: npt.ArrayLike | None, longest_s: float | None
) -> tuple[Array, BilinearAxis | None]:
    """Return the grid, and the map of the imaginary axis to a unit circle for continuous systems."""
    if system.dt > 0:
        grid = log_grid(system.dt, longest_s=longest_s) if freqs_hz is None else check_grid(freqs_hz, system.dt)
        return grid, None
    wide = beyond(continuous_grid(system) if freqs_hz is None else check_grid(freqs_hz, None))
    return wide, BilinearAxis.over(wide)


def _between(freqs: Array, values: Array, at_hz: Array) -> Array:
    """Return responses (unit, frequency, p, m) at other frequencies, on straight lines, constant beyond the ends."""
    right = np.searchsorted(freqs, at_hz).clip(1, max(len(freqs) - 1, 1))
    left, right = right - 1, np.minimum(right, len(freqs) - 1)
    step = np.where(right > left, freqs[right] - freqs[left], 1.0)
    share = ((at_hz - freqs[left]) / step).clip(0.0, 1.0)[:, None, None]
    return np.asarray(values[:, left] * (1 - share) + values[:, right] * share)


def _bound(residuals: Residuals, freqs_hz: Array, time: float | BilinearAxis, options: Options) -> dict[str, Any]:
    """Return weights for the residuals and the remainder, on the mapped axis and back for continuous time."""
    if not isinstance(time, BilinearAxis):
        return _bound_discrete(residuals, freqs_hz, time, options)
    bound = _bound_discrete(time.mapped(residuals), time.discrete_hz(freqs_hz), time.period_s, options)
    weights = {name: bound[name] for name in ("weight", "remainder") if bound.get(name) is not None}
    return bound | {name: weight.mapped(time.continuous) for name, weight in weights.items()}


def _bound_discrete(residuals: Residuals, freqs_hz: Array, dt: float, options: Options) -> dict[str, Any]:
    """Return bound, cover, weight, misfit, and cover and weight of the remainder where the form leaves one."""
    target = Target(dt, options.max_order, options.tolerance_db, options.fit)
    weight, cover = fit_weight(residuals, freqs_hz, target)
    G, ratios, largest = residuals.nominal(freqs_hz), [], []
    for rows in residuals.blocks(options.fit.block):
        E = residuals.of(rows).at(freqs_hz)
        ratios.append(misfit(residuals.form, G, residuals.units(freqs_hz, rows), E))
        largest.append(sigma_max(E).max(axis=0))
    ratio, form = np.concatenate(ratios), residuals.form
    bound = {"bound": np.max(largest, axis=0), "cover": cover, "weight": weight, "misfit": ratio, "form": form}
    if not _leaves_out(residuals.form, ratio):
        return bound
    remainder, remainder_cover = fit_weight(replace(residuals, remainder=True), freqs_hz, target)
    return bound | {"remainder": remainder, "remainder_cover": remainder_cover}


def _leaves_out(form: Form, ratio: Array) -> bool:
    """Tell whether an additive remainder is needed, and warn."""
    unknown = int(np.isnan(ratio).sum())
    if unknown:
        text = "Uncertainty form %s: near singular for %d of %d units and frequencies; the misfit is unknown there."
        _LOG.warning(text, form.value, unknown, ratio.size)
    largest = np.nanmax(ratio) if unknown < ratio.size else np.inf
    if largest <= SET.exact and not unknown:
        return False
    text = (
        "Uncertainty form %s cannot represent up to %.3g of a unit's response; an additive term covers the difference."
    )
    level = logging.WARNING if largest > SET.warned else logging.INFO
    _LOG.log(level, f"{text} The additive form needs none.", form.value, largest)
    return True


def _fields(
    ids: tuple[str, ...], index: int, freqs_hz: Array, scales: tuple[Array, Array], choices: Any, bound: dict[str, Any]
) -> dict[str, Any]:
    """Return the fields of `Uncertainty` for the nominal `index` among the units."""
    name, form = ids[index] if index >= 0 else POOLED, bound["form"]
    return {
        "unit_ids": ids,
        "nominal": index,
        "nominal_id": name,
        "freqs_hz": freqs_hz,
        "output_scale": scales[0],
        "input_scale": scales[1],
        "bounds": {f: choice.bound for f, choice in choices.items()} | {form: bound["bound"]},
        "nominals": {f: ids[choice.index] for f, choice in choices.items()} | {form: name},
        **{key: value for key, value in bound.items() if key != "bound"},
    }
