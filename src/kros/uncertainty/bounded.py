"""From systems or responses of units to an uncertain set: nominal, residuals, and the remainder of the form.

Responses are bounded between their frequencies as if they were straight lines in the complex plane, without a claim
there.

Choice of the nominal: the unit from which all others differ the least (section IV-C).

What a quantification takes: models, responses and scales, read and checked.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..core import ITERATED, AnyArray, ArrayLike, ConfigError, DataError, DimensionError, StateSpace, frozen
from ..core.frequency import log_grid
from ..core.linalg import sigma_max
from ..identify.refine.metric import smallest_largest
from .forms import Form, as_form, check_grid, check_responses, misfit, residual
from .model import ResponseUncertainty, UncertainModel
from .settings import SET, WeightSettings
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
    units = system.multiplied(1 / scales[0], scales[1])
    grid = log_grid(system.dt, longest_s=getattr(models, "longest_s", None)) if freqs_hz is None else freqs_hz
    freqs = check_grid(grid, system.dt)
    fields = _bound(form, units, freqs, system.dt, ids, options)
    fields |= {"output_scale": scales[0], "input_scale": scales[1]}
    return UncertainModel(nominal_system=system[fields["nominal"]], **fields)


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
    bound = fields["bounds"][form]
    text = f"at the {len(freqs)} frequencies given, {freqs[0]:.6g} to {freqs[-1]:.6g} Hz; not between or beyond them"
    middle, (low, high) = bound[1:-1], np.sort([bound[:-2], bound[2:]], axis=0)
    peaked = middle > np.maximum(SET.resolved * low, SET.exact * bound.max())
    unresolved = freqs[1:-1][peaked & (middle >= high)]
    if unresolved.size:
        some = ", ".join(f"{f:.4g}" for f in unresolved[:5])
        text += f"; they do not resolve {unresolved.size} peaks of the residuals, at {some} Hz"
        _LOG.warning("Weights of responses: residuals peak between frequencies, at %s Hz; measure more densely.", some)
    return ResponseUncertainty(nominal_response=G[fields["nominal"]], certificate=text, **fields)


def _bound(
    form: Form, units: StateSpace | Sampled, freqs: AnyArray, dt: float, ids: tuple[str, ...], options: Options
) -> dict[str, Any]:
    """Return the set around the best nominal or that of the options, with the remainder where the form leaves one."""
    responses = units.frequency_response(freqs)
    choices = {form: choose_nominal(responses, form) for form in Form}
    target, index = (dt, options.max_order, options.tolerance_db), options.nominal
    if index is None or index in ids:
        index = choices[form].index if index is None else ids.index(str(index))
    if isinstance(index, str) or not 0 <= index < len(ids):
        known = f"give one of the units {', '.join(ids[:10])}, or a row below {len(ids)}"
        raise ConfigError(f"Quantify: nominal {index!r} is out of range; {known}.")
    residuals, G = Residuals(form, units[index], units, len(ids)), responses[index]
    weight, cover = fit_weight(residuals, freqs, *target)
    ratios, largest = zip(*((misfit(form, G, Gp), sigma_max(E)) for Gp, E in residuals.pieces(freqs)), strict=True)
    ratio, bound = np.concatenate(ratios), np.concatenate(largest).max(axis=0)
    remainder = fit_weight(replace(residuals, remainder=True), freqs, *target)[0] if _leaves_out(form, ratio) else None
    return {
        "form": form,
        "unit_ids": ids,
        "nominal": index,
        "nominal_id": ids[index],
        "freqs_hz": freqs,
        "misfit": ratio,
        "bounds": {f: choice.bound for f, choice in choices.items()} | {form: bound},
        "nominals": {f: ids[choice.index] for f, choice in choices.items()} | {form: ids[index]},
        "cover": cover,
        "weight": weight,
        "remainder": remainder,
    }


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


class Options(WeightSettings):
    """Options of `quantify` for systems and responses, described there."""

    unit_ids: tuple[str, ...] | None = None
    output_scale: Any = None
    input_scale: Any = None
    nominal: str | int | None = None
    sample_period_s: float | None = None

    def scales(self, shape: tuple[int, ...]) -> tuple[AnyArray, AnyArray]:
        """Return the ranges of outputs and inputs."""
        given = {"output": self.output_scale, "input": self.input_scale}
        scales = [np.ones(n) if v is None else np.asarray(v, float) for n, v in zip(shape, given.values(), strict=True)]
        for side, size, scale in zip(given, shape, scales, strict=True):
            if scale.shape != (size,) or not (np.isfinite(scale) & (scale > 0)).all():
                problem = f"{side}_scale needs {size} positive numbers, found {scale[:9]}"
                raise DimensionError(f"Uncertainty: {problem}.")
        return scales[0], scales[1]

    def ids(self, count: int) -> tuple[str, ...]:
        """Return the names of units, ``0, 1, ...`` by default, or raise an error where they do not fit."""
        ids = tuple(str(k) for k in range(count)) if self.unit_ids is None else tuple(self.unit_ids)
        if len(ids) != count or len(set(ids)) != count:
            problem = f"Quantify: needs one id for each of {count} units, all different"
            raise DimensionError(f"{problem}, found {len(ids)} ({', '.join(ids[:5])} ...).")
        if count < 2:
            needs = f"uncertainty of a population needs at least two units, found {count} ({', '.join(ids)})"
            raise DataError(f"Quantify: {needs}; record more units.")
        return ids


def read_systems(models: Any, options: Options) -> tuple[StateSpace, Options]:
    """Return models as a batch of stable systems, and the options with the names and scales that models have."""
    if hasattr(models, "systems") and hasattr(models, "unit_ids"):
        names = ("output_scale", "input_scale", "unit_ids")
        known = {name: getattr(models, name) for name in names if getattr(options, name) is None}
        options = options.model_copy(update=known)
        models = models.systems(tuple(options.unit_ids or ()))
    system = models if isinstance(models, StateSpace) else stack_systems(models)
    if len(system.batch_shape) != 1:
        problem = f"Quantify: needs a batch of models with one unit axis, found the batch shape {system.batch_shape}"
        raise DimensionError(f"{problem}; stack the units.")
    if not system.dt > 0:
        raise ConfigError("Quantify: continuous systems have no weights; sample them, control.sample_system does it.")
    for k, name in enumerate(options.ids(system.batch_shape[0])):
        one = system[k]
        if not one.is_finite():
            raise DataError(
                f"Quantify: the model of unit {name} has NaN or infinity; leave it out or identify it again."
            )
        if not one.is_stable():
            problem = f"the model of unit {name} is unstable (spectral radius {one.spectral_radius():.6f})"
            raise DataError(f"Quantify: {problem}; identify with more regularisation or leave it out.")
    return system, options


def stack_systems(models: Any) -> StateSpace:
    """Return a batch from a sequence of systems with the same outputs, inputs and sampling period."""
    if not isinstance(models, Iterable):
        remedy = "give a list of systems, an array of responses, or the result of kros.identify"
        raise DimensionError(f"Quantify: needs models of at least two units, found {type(models).__name__}; {remedy}.")
    systems = [StateSpace.of(system) for system in models]
    kinds = {(s.n_outputs, s.n_inputs, s.dt) for s in systems}
    if len(kinds) != 1:
        problem = f"Quantify: units differ in (outputs, inputs, sampling period): {sorted(kinds)}"
        raise DimensionError(f"{problem}; identify them alike, and give at least two.")
    most = max(s.n_states for s in systems)

    def padded(system: StateSpace) -> tuple[AnyArray, ...]:
        """Add states without input and output, at rest after a sample."""
        more = (0, most - system.n_states)
        B, C = np.pad(system.B, (more, (0, 0))), np.pad(system.C, ((0, 0), more))
        return np.pad(system.A, more), B, C, system.D

    A, B, C, D = map(np.stack, zip(*map(padded, systems), strict=True))
    return StateSpace(A, B, C, D, systems[0].dt)


def read_response_data(data: Sequence[Any], options: dict[str, Any]) -> tuple[AnyArray, AnyArray]:
    """Return responses (frequency, p, m) and their frequencies, Hz, of objects with `frdata, omega, dt`."""
    first = data[0]
    for k, other in enumerate(data):
        same = other.omega.shape == first.omega.shape and np.allclose(other.omega, first.omega, rtol=ITERATED, atol=0)
        if not same or other.dt != first.dt:
            problem = f"response {k} has other frequencies or another dt ({other.dt}) than the first one ({first.dt})"
            raise DimensionError(f"Quantify: {problem}; bring all to one grid.")
    if first.dt and first.dt is not True:
        options["sample_period_s"] = float(first.dt)
    responses = [np.moveaxis(np.asarray(one.frdata), -1, 0) for one in data]
    return check_responses(responses), np.asarray(first.omega, float) / (2 * np.pi)
