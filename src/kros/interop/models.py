"""Anybody's models to a bounded set: systems of python-control or bare frequency responses in, weights as systems of python-control out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, DimensionError
from ..core.lti import StateSpace
from ..uncertainty import Form, ResponseUncertainty, UncertainModel, quantify_responses, quantify_systems
from .control import to_control  # before python-control, for its message where that is missing

control = import_module("control")
Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class QuantifiedModels:
    """A nominal and weights as systems of python-control: every model is in the set of the form with ``E = left Delta right``.

    Parameters
    ----------
    nominal : control.StateSpace or control.FRD
        In physical units; response data where the models were.
    left, right : control.StateSpace
        Stable, minimum phase, diagonal, in the time of the models; ``||Delta|| <= 1``.
    remainder_left, remainder_right : control.StateSpace or None
        Weights of an additive part that joins the set where the form does not reach every model.
    model : UncertainModel or ResponseUncertainty
        Bounds of all forms, cover, misfit, names.
    certificate : str
        Where the bound is known to hold.
    """

    nominal: Any
    left: Any
    right: Any
    remainder_left: Any
    remainder_right: Any
    model: UncertainModel | ResponseUncertainty
    certificate: str


def quantify_models(
    models: Sequence[Any] | Mapping[str, Any] | npt.ArrayLike,
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    freqs_hz: npt.ArrayLike | None = None,
    *,
    sample_period_s: float | None = None,
    nominal: Any = None,
    extra: Mapping[str, Any] | None = None,
    **options: Any,
) -> QuantifiedModels:
    """Quantify how models differ from a nominal one, whatever they are given as.

    Systems are exact at every frequency: weights of continuous ones are fitted on the unit circle that the bilinear map makes of the imaginary axis and
    mapped back, which approximates nothing; the bound is checked between the points of the grid too, and holds up to the end that the certificate names
    and beyond it for residuals that do not grow there. Frequency responses are known on
    their grid alone, and the certificate says so.

    Parameters
    ----------
    models : sequence or mapping of control.StateSpace, control.TransferFunction or control.FRD, or array_like
        At least two, with names where it is a mapping; all with the same outputs, inputs and time, and all systems or all response data. An array
        holds responses, shape (unit, frequency, outputs, inputs).
    form : Form or str
    freqs_hz : array_like, shape (frequency,), Hz, optional
        Needed with arrays; response data bring their own.
    sample_period_s : float, s, optional
        Needed with arrays only, zero for continuous time.
    nominal : int, str, system or response, optional
        The best by ``criterion`` by default.
    extra : mapping of str to systems or responses, optional
        Further candidates for the nominal.
    **options
        Of `kros.uncertainty.quantify_systems` or `quantify_responses`: ``criterion``, ``output_scale``, ``input_scale``, ``structure``, ``max_order``,
        ``tolerance_db`` and others. Weights act on scaled signals.

    Returns
    -------
    QuantifiedModels

    Raises
    ------
    DimensionError
        Outputs, inputs, time or frequencies differ.
    DataError
        Fewer than two models, unstable or improper ones, NaN.
    ConfigError
        Frequencies missing, or given twice; unknown forms.

    Examples
    --------
    >>> import control
    >>> from kros.interop import quantify_models
    >>> lags = [control.tf([gain], [1, 1]) for gain in (0.9, 1.0, 1.2)]
    >>> found = quantify_models(lags, "output_multiplicative")
    >>> found.model.nominal_id, found.left.dt, round(float(abs(found.left(1j))), 6)
    ('1', 0.0, 0.2)
    """
    listed, ids = _named(models)
    if ids is not None:
        options["unit_ids"] = ids
    kinds = {_kind(model) for model in listed}
    if len(kinds) > 1:
        raise DimensionError(f"quantify_models: found {' and '.join(sorted(kinds))} in one list; give all as systems or all as responses.")
    if not listed:
        raise DataError("quantify_models: found no models; give at least two.")
    if kinds == {"systems"}:
        if sample_period_s is not None:
            raise ConfigError("quantify_models: systems bring their own time; drop sample_period_s.")
        return _of_systems(listed, form, freqs_hz, nominal, extra or {}, options)
    return _of_responses(listed, form, freqs_hz, sample_period_s, nominal, extra or {}, options)


def _named(models: Any) -> tuple[list[Any], tuple[str, ...] | None]:
    if isinstance(models, Mapping):
        return list(models.values()), tuple(models)
    if isinstance(models, (control.lti.LTI, StateSpace)):
        raise DimensionError("quantify_models: found one model; give a list of at least two.")
    return list(models), None


def _kind(model: Any) -> str:
    return "systems" if isinstance(model, (control.StateSpace, control.TransferFunction)) else "responses"


def _of_systems(
    models: list[Any], form: Form | str, freqs_hz: npt.ArrayLike | None, nominal: Any, extra: Mapping[str, Any], options: dict[str, Any]
) -> QuantifiedModels:
    systems = [to_system(model, f"model {k}") for k, model in enumerate(models)]
    base = to_system(nominal, "nominal") if _kind(nominal) == "systems" else nominal
    others = {name: to_system(model, f"candidate {name!r}") for name, model in extra.items()}
    model = quantify_systems(systems, form, freqs_hz, nominal=base, extra=others, **options)
    certificate = "for the systems on the unit circle, checked between the points of the grid and at its ends"
    if model.sample_period_s == 0:
        end = model.freqs_hz[-1]
        certificate = (
            f"for the systems on the imaginary axis up to {end:.6g} Hz, through the bilinear map, checked between the points of the grid; "
            "from there on residuals count as constant"
        )
    return _result(to_control(model.nominal_system, name="nominal"), model, certificate)


def _of_responses(
    models: list[Any],
    form: Form | str,
    freqs_hz: npt.ArrayLike | None,
    sample_period_s: float | None,
    nominal: Any,
    extra: Mapping[str, Any],
    options: dict[str, Any],
) -> QuantifiedModels:
    data = [model for model in models if isinstance(model, control.FRD)]
    if data and len(data) != len(models):
        raise DimensionError("quantify_models: found response data and arrays in one list; give all as one of them.")
    if data:
        if freqs_hz is not None or sample_period_s is not None:
            raise ConfigError("quantify_models: response data bring their own frequencies and time; drop freqs_hz and sample_period_s.")
        freqs_hz, sample_period_s = _common_axis([*data, *extra.values(), *([nominal] if isinstance(nominal, control.FRD) else [])])
    if freqs_hz is None or sample_period_s is None:
        raise ConfigError("quantify_models: arrays need freqs_hz and sample_period_s (zero for continuous time).")
    responses = [_response(model) for model in models]
    shapes = {response.shape for response in responses}
    if len(shapes) > 1:
        raise DimensionError(
            f"quantify_models: responses differ in shape (frequency, outputs, inputs): {sorted(shapes)}; bring them to one."
        )
    base = _response(nominal) if isinstance(nominal, control.FRD) else nominal
    others = {name: _response(response) for name, response in extra.items()}
    model = quantify_responses(np.array(responses), freqs_hz, form, sample_period_s=sample_period_s, nominal=base, extra=others, **options)
    dt = sample_period_s if sample_period_s > 0 else 0
    chosen = control.FRD(np.moveaxis(model.nominal_response, 0, -1), 2 * np.pi * model.freqs_hz, dt)
    return _result(chosen, model, model.certificate)


def _result(nominal: Any, model: UncertainModel | ResponseUncertainty, certificate: str) -> QuantifiedModels:
    extra = model.remainder
    return QuantifiedModels(
        nominal=nominal,
        left=to_control(model.weight.left, name="weight_left"),
        right=to_control(model.weight.right, name="weight_right"),
        remainder_left=None if extra is None else to_control(extra.left, name="remainder_left"),
        remainder_right=None if extra is None else to_control(extra.right, name="remainder_right"),
        model=model,
        certificate=certificate,
    )


def to_system(model: Any, name: str) -> StateSpace:
    """Return a system of python-control as a system of kros, discrete or continuous; transfer functions entry by entry.

    Parameters
    ----------
    model : control.StateSpace or control.TransferFunction
        Entries of a transfer function get states of their own: no minimal realisation is needed for a frequency response.
    name : str
        For messages.

    Returns
    -------
    StateSpace

    Raises
    ------
    DimensionError
        No system, or a sampling period that is not known.
    DataError
        An improper transfer function.
    """
    if _kind(model) != "systems":
        raise DimensionError(f"quantify_models: {name} is a {type(model).__name__}; give a control.StateSpace or control.TransferFunction.")
    if model.dt is None or model.dt is True:
        raise DimensionError(f"quantify_models: the sampling period of {name} is not known (dt = {model.dt}); give it in seconds, or 0.")
    if isinstance(model, control.StateSpace):
        A, B, C, D = (np.array(getattr(model, x), float) for x in "ABCD")
        return StateSpace(A, B, C, D, float(model.dt))
    return _realised(model, name)


def _realised(model: Any, name: str) -> StateSpace:
    from scipy.linalg import block_diag
    from scipy.signal import tf2ss

    p, m = model.noutputs, model.ninputs
    blocks, D = [], np.zeros((p, m))
    for i in range(p):
        for j in range(m):
            numerator, denominator = np.trim_zeros(model.num[i][j], "f"), np.trim_zeros(model.den[i][j], "f")
            if len(numerator) > len(denominator):
                raise DataError(f"quantify_models: entry ({i}, {j}) of {name} is improper; give a causal model.")
            if not numerator.size:
                continue
            if len(denominator) == 1:
                D[i, j] = numerator[0] / denominator[0]
                continue
            a, b, c, d = tf2ss(numerator, denominator)
            D[i, j] = d[0, 0]
            blocks.append((a, b @ np.eye(m)[[j]], np.eye(p)[:, [i]] @ c))
    n = sum(len(a) for a, _, _ in blocks)
    A = block_diag(*(a for a, _, _ in blocks)) if blocks else np.zeros((0, 0))
    B = np.concatenate([np.zeros((0, m)), *(b for _, b, _ in blocks)])
    C = np.concatenate([np.zeros((p, 0)), *(c for _, _, c in blocks)], axis=1)
    return StateSpace(A.reshape(n, n), B, C, D, float(model.dt))


def _common_axis(data: list[Any]) -> tuple[Array, float]:
    """Frequencies and sampling period that all response data share."""
    first = data[0]
    for k, other in enumerate(data):
        if not isinstance(other, control.FRD):
            raise DimensionError(f"quantify_models: candidates beside response data should be response data, found {type(other).__name__}.")
        if other.omega.shape != first.omega.shape or not np.allclose(other.omega, first.omega, rtol=1e-9, atol=0):
            raise DimensionError(
                f"quantify_models: response {k} has other frequencies than the first; interpolate or measure them on one grid."
            )
        if other.dt != first.dt:
            raise DimensionError(f"quantify_models: response {k} has dt = {other.dt}, the first dt = {first.dt}; bring them to one.")
    if first.dt is True:
        raise DimensionError("quantify_models: the sampling period of the responses is not known (dt = True); give it in seconds.")
    return np.asarray(first.omega) / (2 * np.pi), float(first.dt or 0.0)


def _response(model: Any) -> Array:
    if isinstance(model, control.FRD):
        return np.moveaxis(np.asarray(model.frdata), -1, 0)
    response = np.asarray(model)
    if response.ndim != 3:
        raise DimensionError(f"quantify_models: a response has the axes (frequency, output, input), found shape {response.shape}.")
    return response
