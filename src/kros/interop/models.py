"""Models of python-control to a bounded set: systems or response data in, weights as systems of python-control out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, DimensionError
from ..core.lti import StateSpace
from ..uncertainty import Form, quantify_responses, quantify_systems
from .control import UncertaintyForControl, from_control, is_system, uncertainty_to_control, with_weights

control = import_module("control")  # after `.control`, which says what to install where it is missing
Array = npt.NDArray[Any]


def quantify_models(
    models: Sequence[Any] | Mapping[str, Any],
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    freqs_hz: npt.ArrayLike | None = None,
    *,
    nominal: Any = None,
    **options: Any,
) -> UncertaintyForControl:
    """Quantify how models of python-control differ from a nominal one.

    Systems are exact at every frequency: weights of continuous ones are fitted on the unit circle that the bilinear map
    makes of the imaginary axis and mapped back, which approximates nothing; the bound is checked between the points of
    the grid too, and holds up to the end that the certificate names and beyond it for residuals that do not grow there.
    Frequency responses are known on their grid alone, and the certificate says so. (Bare arrays of responses:
    `kros.uncertainty.quantify_responses`.)

    Parameters
    ----------
    models : sequence or mapping of control.StateSpace, control.TransferFunction or control.FRD
        At least two, with names where it is a mapping; all with the same outputs, inputs and time, and all systems or
        all response data.
    form : Form or str
    freqs_hz : array_like, shape (frequency,), Hz, optional
        Response data bring their own.
    nominal : int, str, system or response data, optional
        The best unit by default.
    **options
        Of `kros.uncertainty.quantify_systems` or `quantify_responses`: ``output_scale``, ``input_scale``,
        ``max_order``, ``tolerance_db`` and others. Weights act on scaled signals.

    Returns
    -------
    UncertaintyForControl

    Raises
    ------
    DimensionError
        Outputs, inputs, time or frequencies differ.
    DataError
        Fewer than two models, unstable or improper ones, NaN.
    ConfigError
        Frequencies given twice; unknown forms.

    Examples
    --------
    >>> import control
    >>> from kros.interop import quantify_models
    >>> lags = [control.tf([gain], [1, 1]) for gain in (0.9, 1.0, 1.2)]
    >>> found = quantify_models(lags, "output_multiplicative")
    >>> found.model.nominal_id, found.left.dt, round(float(abs(found.left(1j))), 6)
    ('1', 0.0, 0.2)
    """
    if isinstance(models, (control.lti.LTI, StateSpace)):
        raise DimensionError("quantify_models: found one model; give a list of at least two.")
    if isinstance(models, Mapping):
        options["unit_ids"], models = tuple(models), list(models.values())
    if not len(models):
        raise DataError("quantify_models: found no models; give at least two.")
    if all(is_system(model) for model in models):
        base = from_control(nominal) if is_system(nominal) else nominal
        systems = [from_control(model) for model in models]
        return uncertainty_to_control(quantify_systems(systems, form, freqs_hz, nominal=base, **options))
    if not all(isinstance(model, control.FRD) for model in models):
        kinds = " and ".join(sorted({type(model).__name__ for model in models}))
        raise DimensionError(f"quantify_models: found {kinds} in one list; give all as systems or all as control.FRD.")
    if freqs_hz is not None:
        raise ConfigError("quantify_models: response data bring their own frequencies; drop freqs_hz.")
    return _quantify_data(list(models), form, nominal, options)


def _quantify_data(models: list[Any], form: Form | str, nominal: Any, options: dict[str, Any]) -> UncertaintyForControl:
    """Quantify response data, which are known on their grid alone."""
    freqs, period = _common_axis([*models, *([nominal] if isinstance(nominal, control.FRD) else [])])
    base = _response(nominal) if isinstance(nominal, control.FRD) else nominal
    responses = [_response(model) for model in models]
    shapes = sorted({response.shape for response in responses})
    if len(shapes) > 1:
        problem = f"responses differ in shape (frequency, outputs, inputs), {shapes}"
        raise DimensionError(f"quantify_models: {problem}; bring them to one.")
    model = quantify_responses(np.array(responses), freqs, form, sample_period_s=period, nominal=base, **options)
    G = model.nominal_response
    data, scaled = (
        control.FRD(np.moveaxis(g, 0, -1), 2 * np.pi * model.freqs_hz, period or 0)
        for g in (G, G / model.output_scale[:, None] * model.input_scale)
    )
    return with_weights(data, scaled, model, model.certificate)


def _common_axis(data: list[Any]) -> tuple[Array, float]:
    """Frequencies and sampling period that all response data share."""
    first = data[0]
    for k, other in enumerate(data):
        if not isinstance(other, control.FRD):
            problem = f"candidates beside response data should be response data, found {type(other).__name__}"
            raise DimensionError(f"quantify_models: {problem}.")
        if other.omega.shape != first.omega.shape or not np.allclose(other.omega, first.omega, rtol=1e-9, atol=0):
            problem = f"response {k} has other frequencies than the first"
            raise DimensionError(f"quantify_models: {problem}; interpolate or measure them on one grid.")
        if other.dt != first.dt:
            problem = f"response {k} has dt = {other.dt}, the first dt = {first.dt}"
            raise DimensionError(f"quantify_models: {problem}; bring them to one.")
    if first.dt is True:
        raise DimensionError(
            "quantify_models: the sampling period of the responses is not known (dt = True); give it in seconds."
        )
    return np.asarray(first.omega) / (2 * np.pi), float(first.dt or 0.0)


def _response(data: Any) -> Array:
    """Shape (frequency, outputs, inputs)."""
    return np.moveaxis(np.asarray(data.frdata), -1, 0)
