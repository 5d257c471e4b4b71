"""What a quantification takes: models, responses and scales, read and checked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..core.arrays import AnyArray, ArrayLike
from ..core.errors import ConfigError, DataError, DimensionError
from ..core.lti import StateSpace
from ..core.rounding import ITERATED
from .forms import check_responses
from .settings import WeightSettings


class Options(WeightSettings):
    """Options of `quantify` for systems and responses, described there."""

    unit_ids: tuple[str, ...] | None = None
    output_scale: Any = None
    input_scale: Any = None
    nominal: str | int | None = None
    sample_period_s: float | None = None

    def scales(self, shape: tuple[int, ...]) -> tuple[AnyArray, AnyArray]:
        """Return the ranges of outputs and inputs."""
        return check_scale("output", self.output_scale, shape[0]), check_scale("input", self.input_scale, shape[1])

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

    def row(self, ids: tuple[str, ...], best: int) -> int:
        """Return the row of the nominal among the units: by name or row, otherwise the best."""
        if isinstance(self.nominal, str) and self.nominal in ids:
            return ids.index(self.nominal)
        index = best if self.nominal is None else self.nominal
        if isinstance(index, str) or not 0 <= index < len(ids):
            known = f"give one of the units {', '.join(ids[:10])}, or a row below {len(ids)}"
            raise ConfigError(f"Quantify: nominal {index!r} is out of range; {known}.")
        return index


def read_systems(models: Any, options: Options) -> tuple[StateSpace, Options]:
    """Return models as a batch of stable systems, and the options with the names and scales that models have."""
    if hasattr(models, "systems") and hasattr(models, "unit_ids"):
        names = ("output_scale", "input_scale", "unit_ids")
        known = {name: getattr(models, name) for name in names if getattr(options, name) is None}
        options = options.model_copy(update=known)
        models = models.systems(tuple(options.unit_ids or ()))
    system = stack_systems(models)
    if not system.dt > 0:
        raise ConfigError("Quantify: continuous systems have no weights; sample them, control.sample_system does it.")
    require_stable(system, tuple(f"unit {name}" for name in options.ids(system.batch_shape[0])))
    return system, options


def stack_systems(models: Any) -> StateSpace:
    """Return a batch from a batch, or from a sequence of systems with the same outputs, inputs and sampling period."""
    if not isinstance(models, StateSpace):
        if isinstance(models, str) or not isinstance(models, Iterable):
            remedy = "give a list of systems, an array of responses, or the result of kros.identify"
            raise DimensionError(
                f"Quantify: needs models of at least two units, found {type(models).__name__}; {remedy}."
            )
        systems = [StateSpace.of(system) for system in models]
        kinds = {(s.n_outputs, s.n_inputs, s.dt) for s in systems}
        if len(kinds) != 1:
            problem = f"Quantify: units differ in (outputs, inputs, sampling period): {sorted(kinds)}"
            raise DimensionError(f"{problem}; identify them alike, and give at least two.")
        largest, dt = max(s.n_states for s in systems), systems[0].dt
        padded = [_padded(s, largest - s.n_states) for s in systems]
        A, B, C, D = (np.stack(matrices) for matrices in zip(*padded, strict=True))
        models = StateSpace(A, B, C, D, dt)
    if len(models.batch_shape) != 1:
        problem = f"Quantify: needs a batch of models with one unit axis, found the batch shape {models.batch_shape}"
        raise DimensionError(f"{problem}; stack the units.")
    return models


def _padded(system: StateSpace, more: int) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """Return A, B, C, D with further states without input and output, at rest after a sample."""
    B, C = np.pad(system.B, ((0, more), (0, 0))), np.pad(system.C, ((0, 0), (0, more)))
    return np.pad(system.A, (0, more)), B, C, system.D


def check_scale(side: str, values: ArrayLike | None, size: int) -> AnyArray:
    """Return ranges as an array, ones by default, or say what is wrong with them."""
    scale = np.ones(size) if values is None else np.asarray(values, float)
    if scale.shape != (size,) or not (np.isfinite(scale) & (scale > 0)).all():
        raise DimensionError(f"Uncertainty: {side}_scale needs {size} positive numbers, found {scale[:9]}.")
    return scale


def require_stable(system: StateSpace, names: tuple[str, ...]) -> None:
    """Raise a `DataError` that names the first model of a batch that is not finite or not stable."""
    for k, name in enumerate(names):
        one = system[k]
        if not all(np.isfinite(getattr(one, matrix)).all() for matrix in "ABCD"):
            raise DataError(f"Quantify: the model of {name} has NaN or infinity; leave it out or identify it again.")
        if not one.is_stable():
            problem = f"the model of {name} is unstable (spectral radius {one.spectral_radius():.6f})"
            raise DataError(f"Quantify: {problem}; identify with more regularisation or leave it out.")


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
