"""From the models of a population to an `UncertainModel`: check, scale, choose the nominal, cover, fit, verify."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.frequency import check_grid, dense_grid, log_grid
from ..core.lti import StateSpace
from .bilinear import BilinearAxis, beyond, check_continuous_grid, continuous_grid
from .forms import Form, as_form
from .model import UncertainModel, scale_system
from .nominal.choice import Criterion, NominalChoice, as_criterion, choose_nominal, choose_nominals
from .quantified import findings
from .validation import check_fit, find_nominal, read_candidates, read_models
from .weights.bounded import Bounded, Responder, bound_residuals
from .weights.check import checking_grid
from .weights.cover import Structure, as_structure
from .weights.pencils import ResidualSystems, peaks_hz

Array = npt.NDArray[Any]


def quantify_systems(
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
        1000 logarithmic points over the six decades below Nyquist by default, of a model set from recordings not below what its longest episode
        resolves, one over its length; of continuous models from a hundredth of the slowest to ten
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
    >>> from kros.uncertainty import quantify_systems
    >>> poles = np.array([0.88, 0.9, 0.91])[:, None, None]
    >>> units = StateSpace(poles, 1 - poles, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
    >>> model = quantify_systems(units, "inverse_input_multiplicative")
    >>> model.nominal, model.cover_max <= 1
    (1, True)
    """
    form, criterion, structure = as_form(form), as_criterion(criterion), as_structure(structure)
    check_fit(max_order, tolerance_db, density)
    system, ids, scales = read_models(models, unit_ids, output_scale, input_scale)
    others = read_candidates(extra, system, ids)
    axis, freqs = _axis(system, freqs_hz, getattr(models, "longest_s", None))
    responses = scale_system(system, *scales).frequency_response(freqs)
    of_others = np.array([scale_system(s, *scales).frequency_response(freqs) for s in others.values()]).reshape(-1, *responses.shape[1:])
    choices = choose_by(responses, form, criterion, of_others, candidates, freqs, structure)
    index, nominal_system = find_nominal(nominal, system, ids, others, choices[form].index)
    found = axis.bound(
        form, scale_system(nominal_system, *scales), scale_system(system, *scales), structure, max_order, tolerance_db, density
    )
    return UncertainModel(nominal_system=nominal_system, **findings(form, ids, tuple(others), index, freqs, scales, choices, found))


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
            systems, dt = ResidualSystems(form, nominal, units), self.sample_period_s
            also = peaks_hz(systems, checking_grid(self.freqs_hz, dt, density, filled=True), dt)
            return bound_residuals(
                form, nominal.frequency_response, units.frequency_response, self.freqs_hz, dt, systems, also_hz=also, **options
            )
        mapped = ResidualSystems(form, self.map.discrete(nominal), self.map.discrete(units))
        grid = dense_grid(self.map.discrete_hz(self.freqs_hz), self.map.period_s, density)
        also = peaks_hz(mapped, grid[grid <= self.map.discrete_hz(self.freqs_hz[-1])], self.map.period_s)
        return bound_continuous(
            form, nominal.frequency_response, units.frequency_response, self.freqs_hz, self.map, also_hz=also, **options
        )


def bound_continuous(form: Form, nominal: Responder, units: Responder, freqs_hz: Array, axis: BilinearAxis, **options: Any) -> Bounded:
    """Return continuous weights for responses at continuous frequencies, as `bound_residuals`."""
    back, grid = axis.continuous_hz, axis.discrete_hz(freqs_hz)
    found = bound_residuals(form, lambda f: nominal(back(f)), lambda f: units(back(f)), grid, axis.period_s, **options)
    remainder = None if found.remainder is None else axis.continuous_weight(found.remainder)
    return replace(found, weight=axis.continuous_weight(found.weight), remainder=remainder)


def _axis(system: StateSpace, freqs_hz: npt.ArrayLike | None, longest_s: float | None) -> tuple[_Axis, Array]:
    if system.dt > 0:
        freqs = log_grid(system.dt, longest_s=longest_s) if freqs_hz is None else check_grid(freqs_hz, system.dt)
        return _Axis(freqs, system.dt, None), freqs
    freqs = continuous_grid(system) if freqs_hz is None else check_continuous_grid(freqs_hz)
    wide = beyond(freqs)
    return _Axis(wide, 0.0, BilinearAxis.over(wide)), wide
