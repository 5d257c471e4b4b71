"""Models of python-control to a bounded set: systems or response data in, weights as systems of python-control out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy.typing as npt

from ..core.errors import DataError, DimensionError
from ..uncertainty import Form, quantify
from .control import UncertaintyForControl, from_control, is_system, uncertainty_to_control


def quantify_models(
    models: Sequence[Any] | Mapping[str, Any],
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    freqs_hz: npt.ArrayLike | None = None,
    **options: Any,
) -> UncertaintyForControl:
    """Quantify how models of python-control differ from a nominal one.

    Parameters
    ----------
    models : sequence or mapping of control.StateSpace, control.TransferFunction or control.FRD
        At least two, with names where it is a mapping; all with the same outputs, inputs and time, and all systems or
        all response data.
    form : Form or str
    freqs_hz : array_like, shape (frequency,), Hz, optional
        Response data bring their own.
    **options
        Of `kros.uncertainty.quantify`: ``nominal`` (also as a system or response data), ``output_scale`` and others.

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
    if is_system(models) or not isinstance(models, Sequence | Mapping):
        raise DimensionError(f"quantify_models: found one model, {type(models).__name__}; give a list of at least two.")
    if not models:
        raise DataError("quantify_models: found no models; give at least two.")
    if isinstance(models, Mapping):
        options["unit_ids"], models = tuple(models), list(models.values())
    kinds = {is_system(model) for model in models}
    if len(kinds) > 1 or not (kinds == {True} or all(hasattr(model, "frdata") for model in models)):
        names = sorted({type(model).__name__ for model in models})
        raise DimensionError(
            f"quantify_models: found {' and '.join(names)} in one list; give all as systems or all as control.FRD."
        )
    if is_system(options.get("nominal")):
        options["nominal"] = from_control(options["nominal"])
    systems = [from_control(model) for model in models] if kinds == {True} else models
    return uncertainty_to_control(quantify(systems, form, freqs_hz, **options))
