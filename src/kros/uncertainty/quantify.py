"""From the models of a population to an `UncertainModel`: check, scale, choose the nominal, cover, fit, verify."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, DimensionError
from ..core.frequency import check_grid, log_grid
from ..core.lti import StateSpace
from .bilinear import BilinearAxis, beyond, check_continuous_grid, continuous_grid
from .forms import Form, as_form
from .model import UncertainModel, scale_system
from .population.nominal import Criterion, NominalChoice, as_criterion, choose_nominal, choose_nominals
from .weights.bounded import Bounded, Responder, bound_residuals
from .weights.certificate import ResidualSystems
from .weights.cover import Cover, Structure, as_structure

Array = npt.NDArray[Any]

POOLED = "pooled"


def quantify(
    models: Any,
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    freqs_hz: npt.ArrayLike | None = None,
    *,
    unit_ids: Sequence[str] | None = None,
    output_scale: npt.ArrayLike | None = None,
    input_scale: npt.ArrayLike | None = None,
    nominal: int | str | StateSpace | None = None,
    criterion: Criterion | str = Criterion.PEAK,
    extra: Mapping[str, StateSpace] | None = None,
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
        Stable models, the unit axis first; at least two units. In a sequence any objects with `A, B, C, D, dt` will do. Models of fewer states
        than others get states that do nothing. A model set brings its unit ids and scales. Continuous models (``dt = 0``) are quantified on the
        unit circle that the bilinear map makes of the imaginary axis, and the weights mapped back to continuous time: what bounds there bounds
        here, exactly.
    form : Form or str
        Uncertainty form of the weights; the bounds of all six are reported.
    freqs_hz : array_like, shape (frequency,), Hz, optional
        1000 logarithmic points over the six decades below Nyquist by default; of continuous models from a hundredth of the slowest to ten
        times the fastest pole. To the grid of continuous models points up to ten times its end are added; beyond these, residuals count as constant.
    unit_ids : sequence of str, optional
        Names; ``0, 1, ...`` by default. Of a model set: the units to use.
    output_scale, input_scale : array_like, shape (p,) and (m,), optional
        Ranges of outputs and inputs over the population; residuals and weights are in these units. Ones by default.
    nominal : int, str or StateSpace, optional
        Unit (or name in `extra`) to use as nominal, or a model of its own; by default the best by `criterion`.
    criterion : {"peak", "area", "cost"}
        What the nominal of this form makes small, see `choose_nominal`; those of the other forms have the lowest peaks.
    extra : mapping of str to StateSpace, optional
        Further candidates for the nominal by name, for example a pooled model; they are no units, and need not be covered.
    candidates : array_like of bool, shape (unit,), optional
        Units that may be nominal.
    structure : {"diagonal", "scalar", "full", "entrywise"}
        Of the weights; entrywise ones bound the entries and are sound for a diagonal perturbation only.
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
        Fewer than two units, unstable models, NaN.
    ConfigError
        Unknown form, criterion, structure or nominal, frequencies above Nyquist, an order or tolerance out of range.

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
    form, criterion, structure = as_form(form), as_criterion(criterion), as_structure(structure)
    check_fit(max_order, tolerance_db, density)
    system, ids, scales = _read_models(models, unit_ids, output_scale, input_scale)
    others = _read_extra(extra, system, ids)
    axis, freqs = _axis(system, freqs_hz)
    responses = scale_system(system, *scales).frequency_response(freqs)
    of_others = np.array([scale_system(s, *scales).frequency_response(freqs) for s in others.values()]).reshape(-1, *responses.shape[1:])
    choices = choose_by(responses, form, criterion, of_others, candidates, freqs, structure)
    names = (*ids, *others)
    index, nominal_system = _find_nominal(nominal, system, ids, others, choices[form].index)
    found = axis.bound(
        form, scale_system(nominal_system, *scales), scale_system(system, *scales), structure, max_order, tolerance_db, density
    )
    name = names[index] if index >= 0 else POOLED
    return UncertainModel(
        form=form,
        unit_ids=ids,
        nominal=index if index < len(ids) else -1,
        nominal_id=name,
        nominal_system=nominal_system,
        freqs_hz=freqs,
        output_scale=scales[0],
        input_scale=scales[1],
        bounds={f: choice.bound for f, choice in choices.items()} | {form: found.bound},
        nominals={f: names[choice.index] for f, choice in choices.items()} | {form: name},
        cover=found.cover,
        weight=found.weight,
        misfit=found.misfit,
        remainder=found.remainder,
        remainder_cover=found.remainder_cover,
    )


def choose_by(
    responses: Array,
    form: Form,
    criterion: Criterion,
    extra: Array,
    candidates: npt.ArrayLike | None,
    freqs_hz: Array,
    structure: Structure | str,
) -> dict[Form, NominalChoice]:
    """Return the nominal of every form with the lowest peak, and of one form by a criterion."""
    choices = choose_nominals(responses, extra=extra, candidates=candidates)
    if criterion is not Criterion.PEAK:
        options: dict[str, Any] = {"extra": extra, "candidates": candidates, "freqs_hz": freqs_hz, "structure": structure}
        choices[form] = choose_nominal(responses, form, criterion, **options)
    return choices


@dataclass(frozen=True)
class _Axis:
    """Where weights are fitted: the unit circle of discrete models, or the one that a bilinear map makes of the imaginary axis."""

    freqs_hz: Array
    sample_period_s: float
    map: BilinearAxis | None

    def bound(
        self,
        form: Form,
        nominal: StateSpace,
        units: StateSpace,
        structure: Structure | str,
        max_order: int,
        tolerance_db: float,
        density: int,
    ) -> Bounded:
        """Return weights in the time of the models."""
        options: dict[str, Any] = {"structure": structure, "max_order": max_order, "tolerance_db": tolerance_db, "density": density}
        if self.map is None:
            systems = ResidualSystems(form, nominal, units)
            return bound_residuals(
                form, nominal.frequency_response, units.frequency_response, self.freqs_hz, self.sample_period_s, systems, **options
            )
        return bound_continuous(form, nominal.frequency_response, units.frequency_response, self.freqs_hz, self.map, **options)


def bound_continuous(form: Form, nominal: Responder, units: Responder, freqs_hz: Array, axis: BilinearAxis, **options: Any) -> Bounded:
    """Return continuous weights for responses at continuous frequencies, as `bound_residuals`."""
    back, count = axis.continuous_hz, len(freqs_hz)
    grid = np.concatenate([axis.discrete_hz(freqs_hz), axis.held()])
    found = bound_residuals(form, lambda f: nominal(back(f)), lambda f: units(back(f)), grid, axis.period_s, **options)
    return Bounded(
        bound=found.bound[:count],
        cover=Cover(found.cover.left[:count], found.cover.right[:count]),
        weight=axis.continuous_weight(found.weight),
        misfit=found.misfit[:, :count],
        remainder=None if found.remainder is None else axis.continuous_weight(found.remainder),
        remainder_cover=found.remainder_cover and Cover(found.remainder_cover.left[:count], found.remainder_cover.right[:count]),
    )


def _axis(system: StateSpace, freqs_hz: npt.ArrayLike | None) -> tuple[_Axis, Array]:
    if system.dt > 0:
        freqs = log_grid(system.dt) if freqs_hz is None else check_grid(freqs_hz, system.dt)
        return _Axis(freqs, system.dt, None), freqs
    freqs = continuous_grid(system) if freqs_hz is None else check_continuous_grid(freqs_hz)
    wide = beyond(freqs)
    return _Axis(wide, 0.0, BilinearAxis.over(wide)), wide


def _read_extra(extra: Mapping[str, StateSpace] | None, system: StateSpace, ids: tuple[str, ...]) -> dict[str, StateSpace]:
    """Further candidates, checked like units."""
    others = dict(extra or {})
    for name, candidate in others.items():
        if name in ids:
            raise ConfigError(f"Quantify: candidate {name!r} has the name of a unit; give it another.")
        _check_candidate(candidate, system)
        _check(candidate[None], (f"candidate {name}",))
    return others


def check_fit(max_order: int, tolerance_db: float, density: int = 1) -> None:
    """Raise a `ConfigError` when an option of the fit is out of range."""
    if not (isinstance(max_order, (int, np.integer)) and max_order >= 0 and tolerance_db >= 0 and density >= 1):
        raise ConfigError(
            f"Quantify: max_order = {max_order!r} should be a whole number from 0, tolerance_db = {tolerance_db} not negative, "
            f"density = {density} at least 1."
        )


def _check_candidate(nominal: StateSpace, system: StateSpace) -> None:
    if nominal.batch_shape or (nominal.n_outputs, nominal.n_inputs, nominal.dt) != (system.n_outputs, system.n_inputs, system.dt):
        raise DimensionError(
            f"Quantify: the nominal should be one system with {system.n_outputs} outputs, {system.n_inputs} inputs at {system.dt} s, found "
            f"{nominal.n_outputs}, {nominal.n_inputs} at {nominal.dt} s in a batch of {nominal.batch_shape}."
        )


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
    if count < 2:
        raise DataError(
            f"Quantify: uncertainty of a population needs at least two units, found {count} ({', '.join(ids)}); record more units."
        )
    _check(system, tuple(f"unit {name}" for name in ids))
    return system, ids, (check_scale("output", output_scale, system.n_outputs), check_scale("input", input_scale, system.n_inputs))


def stack_systems(models: Any) -> StateSpace:
    """Return a batch from a batch, or from a sequence of systems with the same outputs, inputs and sampling period.

    Systems with fewer states than others get further ones that are stable and do nothing.

    Raises
    ------
    DimensionError
        When they differ, or a single system without the unit axis is given.
    """
    if not isinstance(models, StateSpace):
        if isinstance(models, str) or not isinstance(models, Iterable):
            raise DimensionError(
                f"Quantify: needs the models of at least two units, found {type(models).__name__}; give a list of systems."
            )
        systems = [StateSpace.of(system) for system in models]
        found = {(s.n_outputs, s.n_inputs, s.dt) for s in systems}
        if len(found) != 1:
            raise DimensionError(
                f"Quantify: units differ in (outputs, inputs, sampling period): {sorted(found)}; identify them alike."
                if systems
                else "Quantify: found no models; give at least two."
            )
        n_states = max(s.n_states for s in systems)
        systems = [_padded(s, n_states) for s in systems]
        A, B, C, D = (np.stack([getattr(s, x) for s in systems]) for x in "ABCD")
        models = StateSpace(A, B, C, D, systems[0].dt)
    if len(models.batch_shape) != 1:
        raise DimensionError(
            f"Quantify: needs a batch of models with one unit axis, found the batch shape {models.batch_shape}; stack the units."
        )
    return models


def _padded(system: StateSpace, n_states: int) -> StateSpace:
    """Add states without input and output: at rest after one sample, or decaying as fast as the system's slowest mode."""
    more = n_states - system.n_states
    if not more:
        return system
    slowest = np.abs(system.poles().real).min() if system.n_states else 1.0
    A = np.zeros((n_states, n_states))
    A[: system.n_states, : system.n_states] = system.A
    if system.dt == 0:
        A[system.n_states :, system.n_states :] = -max(slowest, 1e-300) * np.eye(more)
    B, C = np.pad(system.B, ((0, more), (0, 0))), np.pad(system.C, ((0, 0), (0, more)))
    return StateSpace(A, B, C, system.D, system.dt)


def _check(system: StateSpace, names: tuple[str, ...]) -> None:
    """Raise a `DataError` that names the first model of a batch that is not finite or not stable."""
    count = (len(names),)
    finite = np.ones(count, bool)
    for name in "ABCD":
        finite &= np.broadcast_to(np.isfinite(getattr(system, name)).all(axis=(-2, -1)), count)
    if not finite.all():
        raise DataError(f"Quantify: the model of {names[int(np.argmin(finite))]} has NaN or infinity; leave it out or identify it again.")
    stable = np.broadcast_to(system.is_stable(), count)
    if not stable.all():
        first = int(np.argmin(stable))
        poles = np.broadcast_to(system.poles(), (*count, system.n_states))[first]
        worst = f"spectral radius {np.abs(poles).max():.6f}" if system.dt > 0 else f"largest real part of a pole {poles.real.max():.6g}"
        raise DataError(
            f"Quantify: the model of {names[first]} is unstable ({worst}, {int((~stable).sum())} in all); "
            "identify with more regularisation or leave it out."
        )


def check_scale(side: str, values: npt.ArrayLike | None, size: int) -> Array:
    """Return ranges as an array, ones by default, or say what is wrong with them."""
    scale = np.ones(size) if values is None else np.asarray(values, float)
    if scale.shape != (size,) or not (np.isfinite(scale) & (scale > 0)).all():
        raise DimensionError(f"Quantify: {side}_scale needs {size} positive ranges, found {np.array2string(scale, threshold=10)}.")
    return scale


def _find_nominal(
    nominal: int | str | StateSpace | None, system: StateSpace, ids: tuple[str, ...], others: Mapping[str, StateSpace], best: int
) -> tuple[int, StateSpace]:
    """Row of the nominal among units and candidates (-1 for a model of its own) and its system."""
    if isinstance(nominal, StateSpace):
        _check_candidate(nominal, system)
        _check(nominal[None], ("the nominal",))
        return -1, nominal
    names = (*ids, *others)
    if isinstance(nominal, str):
        if nominal not in names:
            raise ConfigError(f"Quantify: nominal {nominal!r} is not among the units {', '.join(names[:10])}.")
        nominal = names.index(nominal)
    index = best if nominal is None else nominal
    if not isinstance(index, (int, np.integer)) or not 0 <= index < len(names):
        raise ConfigError(f"Quantify: nominal {index!r} is out of range; give a name, a system, or a whole number below {len(names)}.")
    return int(index), system[index] if index < len(ids) else others[names[index]]
