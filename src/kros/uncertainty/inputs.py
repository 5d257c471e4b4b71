"""What a quantification is given: models, responses, a nominal and scales, read and checked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, DimensionError
from ..core.lti import StateSpace

Array = npt.NDArray[Any]


def read_systems(
    models: Any, unit_ids: Sequence[str] | None, output_scale: npt.ArrayLike | None, input_scale: npt.ArrayLike | None
) -> tuple[StateSpace, tuple[str, ...], tuple[Array, Array]]:
    """Return models as a checked batch, with ids and scales."""
    if hasattr(models, "systems") and hasattr(models, "unit_ids"):
        output_scale = models.output_scale if output_scale is None else output_scale
        input_scale = models.input_scale if input_scale is None else input_scale
        unit_ids = tuple(models.unit_ids) if unit_ids is None else tuple(unit_ids)
        models = models.systems(unit_ids)
    system = stack_systems(models)
    ids = check_ids(unit_ids, system.batch_shape[0])
    _check_stable(system, tuple(f"unit {name}" for name in ids))
    return system, ids, check_scales(output_scale, input_scale, system.D.shape[-2:])


def check_ids(unit_ids: Sequence[str] | None, count: int) -> tuple[str, ...]:
    """Return the names of units, ``0, 1, ...`` by default, or raise an error where they do not fit."""
    ids = tuple(str(k) for k in range(count)) if unit_ids is None else tuple(unit_ids)
    if len(ids) != count or len(set(ids)) != count:
        problem = f"Quantify: needs one id for each of {count} units, all different"
        raise DimensionError(f"{problem}, found {len(ids)} ({', '.join(ids[:5])} ...).")
    if count < 2:
        needs = f"uncertainty of a population needs at least two units, found {count} ({', '.join(ids)})"
        raise DataError(f"Quantify: {needs}; record more units.")
    return ids


def stack_systems(models: Any) -> StateSpace:
    """Return a batch from a batch, or from a sequence of systems with the same outputs, inputs and sampling period."""
    if not isinstance(models, StateSpace):
        if isinstance(models, str) or not isinstance(models, Iterable):
            raise DimensionError(
                f"Quantify: needs the models of at least two units, found {type(models).__name__}; give a list of "
                "systems, an array of responses, or the result of kros.identify."
            )
        systems = [StateSpace.of(system) for system in models]
        kinds = {(s.n_outputs, s.n_inputs, s.dt) for s in systems}
        if len(kinds) != 1:
            problem = f"Quantify: units differ in (outputs, inputs, sampling period): {sorted(kinds)}"
            raise DimensionError(f"{problem}; identify them alike, and give at least two.")
        n_states = max(s.n_states for s in systems)
        systems = [_padded(s, n_states) for s in systems]
        A, B, C, D = (np.stack([getattr(s, x) for s in systems]) for x in "ABCD")
        models = StateSpace(A, B, C, D, systems[0].dt)
    if len(models.batch_shape) != 1:
        problem = f"Quantify: needs a batch of models with one unit axis, found the batch shape {models.batch_shape}"
        raise DimensionError(f"{problem}; stack the units.")
    return models


def find_nominal(nominal: Any, names: tuple[str, ...], best: int) -> int:
    """Row of the nominal among the units: by name or row, otherwise the best."""
    if isinstance(nominal, str):
        if nominal not in names:
            raise ConfigError(f"Quantify: nominal {nominal!r} is not among the units {', '.join(names[:10])}.")
        return names.index(nominal)
    index = best if nominal is None else nominal
    if not isinstance(index, (int, np.integer)) or not 0 <= index < len(names):
        raise ConfigError(
            f"Quantify: nominal {index!r} is out of range; give a name, a system, or a row below {len(names)}."
        )
    return int(index)


def check_scale(side: str, values: npt.ArrayLike | None, size: int) -> Array:
    """Return ranges as an array, ones by default, or say what is wrong with them."""
    scale = np.ones(size) if values is None else np.asarray(values, float)
    if scale.shape != (size,) or not (np.isfinite(scale) & (scale > 0)).all():
        raise DimensionError(f"Uncertainty: {side}_scale needs {size} positive numbers, found {scale[:9]}.")
    return scale


def check_scales(
    output_scale: npt.ArrayLike | None, input_scale: npt.ArrayLike | None, shape: tuple[int, ...]
) -> tuple[Array, Array]:
    """Return the ranges of outputs and inputs."""
    return check_scale("output", output_scale, shape[0]), check_scale("input", input_scale, shape[1])


def check_candidate(candidate: StateSpace, system: StateSpace) -> None:
    """Raise an error when a nominal that is no unit is not one stable system like the units."""
    kinds = [(s.n_outputs, s.n_inputs, s.dt) for s in (candidate, system)]
    if candidate.batch_shape or kinds[0] != kinds[1]:
        problem = f"Quantify: the nominal should be one system with (outputs, inputs, sampling period) {kinds[1]}"
        raise DimensionError(f"{problem}, found {kinds[0]} in a batch of {candidate.batch_shape}.")
    _check_stable(candidate[None], ("the nominal",))


def _check_stable(system: StateSpace, names: tuple[str, ...]) -> None:
    """Raise a `DataError` that names the first model of a batch that is not finite or not stable."""
    count = (len(names),)
    matrices = (system.A, system.B, system.C, system.D)
    finite = np.all([np.broadcast_to(np.isfinite(M).all(axis=(-2, -1)), count) for M in matrices], axis=0)
    if not finite.all():
        name = names[int(np.argmin(finite))]
        raise DataError(f"Quantify: the model of {name} has NaN or infinity; leave it out or identify it again.")
    stable = np.broadcast_to(system.is_stable(), count)
    if stable.all():
        return
    first = int(np.argmin(stable))
    poles = np.broadcast_to(system.poles(), (*count, system.n_states))[first]
    worst = f"largest real part of a pole {poles.real.max():.6g}"
    if system.dt > 0:
        worst = f"spectral radius {np.abs(poles).max():.6f}"
    problem = f"Quantify: the model of {names[first]} is unstable ({worst}, {int((~stable).sum())} in all)"
    raise DataError(f"{problem}; identify with more regularisation or leave it out.")


def _padded(system: StateSpace, n_states: int) -> StateSpace:
    """Add states without input and output, at rest after a sample or as slow as the slowest."""
    more = n_states - system.n_states
    A = np.pad(system.A, (0, more))
    if system.dt == 0 and more:
        slowest = np.abs(system.poles().real).min() if system.n_states else 1.0
        A[system.n_states :, system.n_states :] = -max(slowest, 1e-300) * np.eye(more)
    B, C = np.pad(system.B, ((0, more), (0, 0))), np.pad(system.C, ((0, 0), (0, more)))
    return StateSpace(A, B, C, system.D, system.dt)


def check_response(name: str, response: Array, shape: tuple[int, ...], freqs: Array) -> None:
    """Raise a `DimensionError` or `DataError` when a response is not like the others, or not finite."""
    if response.shape != shape:
        raise DimensionError(f"Quantify: the response of {name!r} should have shape {shape}, found {response.shape}.")
    finite = np.isfinite(response).all(axis=(1, 2))
    if not finite.all():
        at = freqs[int(np.argmin(finite))]
        raise DataError(
            f"Quantify: the response of {name!r} has NaN or infinity at {at:.6g} Hz; leave one of both out."
        )


def read_response_data(
    data: Sequence[Any], freqs_hz: npt.ArrayLike | None, options: dict[str, Any]
) -> tuple[Array, Array]:
    """Return responses (unit, frequency, p, m) and their frequencies, Hz, of objects with `frdata, omega, dt`."""
    first, nominal = data[0], options.get("nominal")
    beside = [nominal] if hasattr(nominal, "frdata") else []
    for k, other in enumerate([*data, *beside]):
        name = f"response {k}" if k < len(data) else "the nominal"
        if other.omega.shape != first.omega.shape or not np.allclose(other.omega, first.omega, rtol=1e-9, atol=0):
            raise DimensionError(
                f"Quantify: {name} has other frequencies than the first response; interpolate to one grid."
            )
        if other.dt != first.dt or other.frdata.shape != first.frdata.shape:
            raise DimensionError(
                f"Quantify: {name} has the shape {other.frdata.shape} and dt = {other.dt}, the first response "
                f"{first.frdata.shape} and {first.dt}; bring them to one."
            )
    if freqs_hz is not None:
        raise ConfigError("Quantify: response data bring their own frequencies; drop freqs_hz.")
    if first.dt is True:
        raise DimensionError("Quantify: the responses have no sampling period (dt = True); give it in seconds.")
    options["sample_period_s"] = float(first.dt or 0.0)
    responses = np.array([np.moveaxis(np.asarray(one.frdata), -1, 0) for one in [*data, *beside]])
    if beside:
        options["nominal"] = responses[-1]
    return responses[: len(data)], np.asarray(first.omega, float) / (2 * np.pi)
