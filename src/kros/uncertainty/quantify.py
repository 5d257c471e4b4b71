"""From the models of a population to an `UncertainModel`: check, scale, choose the nominal, cover, fit, verify."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, DimensionError
from ..core.frequency import check_grid, log_grid
from ..core.lti import StateSpace
from .cover import Cover, Structure
from .forms import Form, as_form, rebuild, residual
from .model import UncertainModel, scale_system
from .nominal import choose_nominals
from .residuals import misfit, sigma_max
from .weights import Weight, fit_weight

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
MISFIT = 0.01  # relative misfit beyond which an additive remainder joins the set
POOLED = "pooled"
_REMAINDER_TOLERANCE = 1.5  # the remainder is small: its weight may be looser by this factor


def quantify(
    models: Any,
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    freqs_hz: npt.ArrayLike | None = None,
    *,
    unit_ids: Sequence[str] | None = None,
    output_scale: npt.ArrayLike | None = None,
    input_scale: npt.ArrayLike | None = None,
    nominal: int | str | StateSpace | None = None,
    candidates: npt.ArrayLike | None = None,
    structure: Structure | str = Structure.DIAGONAL,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    density: int = 10,
) -> UncertainModel:
    """Quantify how the units of a population differ from a nominal one.

    Parameters
    ----------
    models : StateSpace, sequence of StateSpace, or ModelSet
        Stable discrete models, the unit axis first; at least two units. A model set brings its unit ids and scales.
    form : Form or str
        Uncertainty form of the weights; the bounds of all six are reported.
    freqs_hz : array_like, shape (frequency,), Hz, optional
        1000 logarithmic points over the six decades below Nyquist by default.
    unit_ids : sequence of str, optional
        Names; ``0, 1, ...`` by default. Of a model set: the units to use.
    output_scale, input_scale : array_like, shape (p,) and (m,), optional
        Ranges of outputs and inputs over the population; residuals and weights are in these units. Ones by default.
    nominal : int, str or StateSpace, optional
        Unit to use as nominal, or a model of its own; by default the unit with the lowest peak residual of this form.
    candidates : array_like of bool, shape (unit,), optional
        Units that may be nominal.
    structure : {"diagonal", "scalar"}
    max_order : int
        Largest order of one entry of a weight.
    tolerance_db : float, dB
        Overbound at which a lower order is good enough.
    density : int
        How much denser the grid is on which the bound is verified.

    Returns
    -------
    UncertainModel
        With all units identical: weights of zero, `cover_max` 0 and a peak of minus infinity.

    Raises
    ------
    DimensionError
        Sizes or sampling periods differ, or scales do not fit.
    DataError
        Fewer than two units, unstable or continuous models, NaN.
    ConfigError
        Unknown form or nominal, frequencies above Nyquist.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace
    >>> from kros.uncertainty import quantify
    >>> poles = np.array([0.88, 0.9, 0.91])[:, None, None]
    >>> units = StateSpace(poles, 1 - poles, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
    >>> model = quantify(units, "inverse_input_multiplicative")
    >>> model.nominal, model.cover_max <= 1
    (1, True)
    """
    form = as_form(form)
    system, ids, scales = _read_models(models, unit_ids, output_scale, input_scale)
    freqs = log_grid(system.dt) if freqs_hz is None else check_grid(freqs_hz, system.dt)
    responses = scale_system(system, *scales).frequency_response(freqs)
    choices = choose_nominals(responses, candidates=candidates)
    index, nominal_system = _find_nominal(nominal, system, ids, choices[form].index)
    population = _Residuals(form, scale_system(system, *scales), scale_system(nominal_system, *scales))
    options: dict[str, Any] = {"structure": structure, "max_order": max_order, "tolerance_db": tolerance_db, "density": density}
    weight, cover = fit_weight(population.of_form, freqs, system.dt, **options)
    G = population.nominal.frequency_response(freqs)
    E = residual(form, G, responses)
    ratio = misfit(form, G, responses, E)
    remainder, remainder_cover = _remainder(population, freqs, ratio, options)
    bounds = {f: choice.bound for f, choice in choices.items()} | {form: sigma_max(E).max(axis=0)}
    name = ids[index] if index >= 0 else POOLED
    return UncertainModel(
        form=form,
        unit_ids=ids,
        nominal=index,
        nominal_id=name,
        nominal_system=nominal_system,
        freqs_hz=freqs,
        output_scale=scales[0],
        input_scale=scales[1],
        bounds=bounds,
        nominals={f: ids[choice.index] for f, choice in choices.items()} | {form: name},
        cover=cover,
        weight=weight,
        misfit=ratio,
        remainder=remainder,
        remainder_cover=remainder_cover,
    )


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Residuals of the scaled units at any frequency."""

    form: Form
    units: StateSpace
    nominal: StateSpace

    @cached_property
    def _memory(self) -> dict[bytes, tuple[Array, Array]]:
        return {}

    def _responses(self, freqs_hz: Array) -> tuple[Array, Array]:
        key = freqs_hz.tobytes()
        if key not in self._memory:
            self._memory[key] = self.nominal.frequency_response(freqs_hz), self.units.frequency_response(freqs_hz)
        return self._memory[key]

    def of_form(self, freqs_hz: Array) -> Array:
        """Residuals of the form."""
        return residual(self.form, *self._responses(freqs_hz))

    def left_over(self, freqs_hz: Array) -> Array:
        """What the form does not rebuild; NaN (a singular inverse) counts as the whole difference from the nominal."""
        G, Gp = self._responses(freqs_hz)
        rest = Gp - rebuild(self.form, G, residual(self.form, G, Gp))
        return np.where(np.isfinite(rest).all(axis=(-2, -1), keepdims=True), rest, Gp - G)


def _remainder(population: _Residuals, freqs: Array, ratio: Array, options: dict[str, Any]) -> tuple[Weight | None, Cover | None]:
    """Additive weight for the misfit, where it exceeds one percent."""
    unknown = int(np.isnan(ratio).sum())
    if unknown:
        _LOG.warning(
            "Uncertainty form %s: near singular (condition above 1e12) for %d of %d units and frequencies; the misfit is unknown there.",
            population.form.value,
            unknown,
            ratio.size,
        )
    largest = np.nanmax(ratio) if unknown < ratio.size else np.inf
    if largest <= MISFIT:
        return None, None
    _LOG.warning(
        "Uncertainty form %s leaves out up to %.3g of a unit's response; an additive remainder joins the set. The additive form leaves nothing.",
        population.form.value,
        largest,
    )
    looser = options | {"tolerance_db": _REMAINDER_TOLERANCE * options["tolerance_db"]}
    return fit_weight(population.left_over, freqs, population.nominal.dt, **looser)


def _read_models(
    models: Any, unit_ids: Sequence[str] | None, output_scale: npt.ArrayLike | None, input_scale: npt.ArrayLike | None
) -> tuple[StateSpace, tuple[str, ...], tuple[Array, Array]]:
    """Models as a checked batch, ids and scales."""
    if hasattr(models, "systems") and hasattr(models, "unit_ids"):
        output_scale = models.output_scale if output_scale is None else output_scale
        input_scale = models.input_scale if input_scale is None else input_scale
        unit_ids = tuple(models.unit_ids) if unit_ids is None else tuple(unit_ids)
        models = models.systems(unit_ids)
    system = stack_systems(models)
    count = system.batch_shape[0]
    ids = tuple(str(k) for k in range(count)) if unit_ids is None else tuple(unit_ids)
    if len(ids) != count or len(set(ids)) != count:
        raise DimensionError(
            f"Quantify: needs one id for each of {count} units, all different, found {len(ids)} ({', '.join(ids[:5])} ...)."
        )
    _check(system, ids)
    return system, ids, (_scale("output", output_scale, system.n_outputs), _scale("input", input_scale, system.n_inputs))


def stack_systems(models: Any) -> StateSpace:
    """Return a batch from a batch, or from a sequence of systems with the same sizes and sampling period.

    Raises
    ------
    DimensionError
        When they differ, or a single system without the unit axis is given.
    """
    if not isinstance(models, StateSpace):
        systems = list(models)
        found = {(s.n_states, s.n_outputs, s.n_inputs, s.dt) for s in systems}
        if len(found) != 1:
            raise DimensionError(
                f"Quantify: units differ in (states, outputs, inputs, sampling period): {sorted(found)}; identify them alike."
            )
        A, B, C, D = (np.stack([getattr(s, x) for s in systems]) for x in "ABCD")
        models = StateSpace(A, B, C, D, systems[0].dt)
    if len(models.batch_shape) != 1:
        raise DimensionError(
            f"Quantify: needs a batch of models with one unit axis, found the batch shape {models.batch_shape}; stack the units."
        )
    return models


def _check(system: StateSpace, ids: tuple[str, ...]) -> None:
    if len(ids) < 2:
        raise DataError(
            f"Quantify: uncertainty of a population needs at least two units, found {len(ids)} ({', '.join(ids)}); record more units."
        )
    if system.dt <= 0:
        raise DataError("Quantify: found continuous-time models; weights are fitted in discrete time, so sample the models first.")
    finite = np.ones(len(ids), bool)
    for name in "ABCD":
        finite &= np.broadcast_to(np.isfinite(getattr(system, name)).all(axis=(-2, -1)), (len(ids),))
    if not finite.all():
        raise DataError(
            f"Quantify: unit {ids[int(np.argmin(finite))]} has NaN or infinity in its model; leave it out or identify it again."
        )
    stable = np.broadcast_to(system.is_stable(), (len(ids),))
    if not stable.all():
        unit = int(np.argmin(stable))
        radius = np.broadcast_to(system.spectral_radius(), (len(ids),))[unit]
        raise DataError(
            f"Quantify: the model of unit {ids[unit]} is unstable (spectral radius {radius:.6f}, {int((~stable).sum())} units in all); "
            "identify with more regularisation or leave it out."
        )


def _scale(side: str, values: npt.ArrayLike | None, size: int) -> Array:
    scale = np.ones(size) if values is None else np.asarray(values, float)
    if scale.shape != (size,) or not (np.isfinite(scale) & (scale > 0)).all():
        raise DimensionError(f"Quantify: {side}_scale needs {size} positive ranges, found {np.array2string(scale, threshold=10)}.")
    return scale


def _find_nominal(nominal: int | str | StateSpace | None, system: StateSpace, ids: tuple[str, ...], best: int) -> tuple[int, StateSpace]:
    """Row of the nominal (-1 for a model of its own) and its system."""
    if isinstance(nominal, StateSpace):
        if nominal.batch_shape or (nominal.n_outputs, nominal.n_inputs, nominal.dt) != (system.n_outputs, system.n_inputs, system.dt):
            raise DimensionError(
                f"Quantify: the nominal should be one system with {system.n_outputs} outputs, {system.n_inputs} inputs at {system.dt} s, found "
                f"{nominal.n_outputs}, {nominal.n_inputs} at {nominal.dt} s in a batch of {nominal.batch_shape}."
            )
        return -1, nominal
    if isinstance(nominal, str):
        if nominal not in ids:
            raise ConfigError(f"Quantify: nominal {nominal!r} is not among the units {', '.join(ids[:10])}.")
        nominal = ids.index(nominal)
    index = best if nominal is None else int(nominal)
    if not 0 <= index < len(ids):
        raise ConfigError(f"Quantify: nominal {index} is out of range for {len(ids)} units.")
    return index, system[index]
