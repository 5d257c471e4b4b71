"""From the models of a population to an `UncertainModel`: check, scale, choose the nominal, cover, fit, verify."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy.typing as npt

from ..core.frequency import check_grid, dense_grid, log_grid
from ..core.lti import StateSpace
from .bilinear import BilinearAxis, beyond, continuous_grid
from .forms import Form
from .many import bound_many, is_many
from .model import UncertainModel, scale_system
from .nominal.choice import choose_nominals
from .quantification import AUTO, Bounded, Quantification
from .validation import check_candidate, find_nominal, read_models
from .weights.check import DENSITY, checking_grid
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
    structure: str = AUTO,
    max_order: int = 4,
    tolerance_db: float = 1.0,
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
        Unit to use as nominal, or a model of its own; by default the unit with the lowest peak, see `choose_nominal`.
    structure : {"auto", "entrywise"}
        Of the weights. Automatic ones are diagonal, or scalar where diagonal ones come close to an ill-posed set or are fitted badly; the paper's
        entrywise ones bound the entries, which is sound for a diagonal perturbation only.
    max_order : int
        Largest order of one entry of a weight.
    tolerance_db : float, dB
        Overbound at which a lower order is good enough.

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
        Unknown form, structure or nominal, frequencies above Nyquist, an order or tolerance out of range.

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
    asked = Quantification.of(form, structure, max_order, tolerance_db)
    system, ids, scales = read_models(models, unit_ids, output_scale, input_scale)
    freqs, time = _axis(system, freqs_hz, getattr(models, "longest_s", None))
    units = scale_system(system, *scales)
    responses = units.frequency_response(freqs)
    choices = choose_nominals(responses)
    if isinstance(nominal, StateSpace):
        check_candidate(nominal, system, "the nominal")
        index, chosen = -1, nominal
    else:
        index = find_nominal(nominal, ids, choices[asked.form].index)
        chosen = system[index]
    base = scale_system(chosen, *scales)
    found = (
        bound_many(asked, base, units, freqs)
        if is_many(asked, len(ids), time)
        else _bound_all(asked, base, units, freqs, time)
    )
    return UncertainModel(nominal_system=chosen, **asked.fields(ids, index, freqs, scales, choices, found))


def _bound_all(
    asked: Quantification, base: StateSpace, units: StateSpace, freqs: Array, time: float | BilinearAxis
) -> Bounded:
    """Return weights from the residuals of all units at once."""
    if isinstance(time, BilinearAxis):
        residuals = ResidualSystems(asked.form, time.discrete(base), time.discrete(units))
        grid, dt = dense_grid(time.discrete_hz(freqs), time.period_s, DENSITY), time.period_s
        grid = grid[grid <= time.discrete_hz(freqs[-1])]
        exact = (
            None  # beyond the end of the grid residuals count as constant, which those of the mapped systems are not
        )
    else:
        residuals, dt = ResidualSystems(asked.form, base, units), time
        grid, exact = checking_grid(freqs, dt, DENSITY, filled=True), residuals
    also = peaks_hz(residuals, grid, dt)
    return asked.bound(base.frequency_response, units.frequency_response, freqs, time, systems=exact, also_hz=also)


def _axis(
    system: StateSpace, freqs_hz: npt.ArrayLike | None, longest_s: float | None
) -> tuple[Array, float | BilinearAxis]:
    """Grid, and the sampling period or the map of the imaginary axis to a unit circle."""
    if system.dt > 0:
        return log_grid(system.dt, longest_s=longest_s) if freqs_hz is None else check_grid(
            freqs_hz, system.dt
        ), system.dt
    wide = beyond(continuous_grid(system) if freqs_hz is None else check_grid(freqs_hz, None))
    return wide, BilinearAxis.over(wide)
