"""Systems to and from python-control, with the names of their signals.

kros.core.StateSpace (a batch) ── to_control ──► control.StateSpace (a list) ── from_control ──► kros.core.StateSpace
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import DimensionError, MissingDependencyError
from ..core.lti import StateSpace
from ..identify import ModelSet
from ..uncertainty import UncertainModel

try:
    import control
except ImportError as error:
    raise MissingDependencyError(
        "kros.interop.control needs python-control, which is not installed; install it (pip install 'kros[control]')."
    ) from error


@dataclass(frozen=True, eq=False)
class UncertaintyForControl:
    """An uncertain model as python-control systems; the weights act on scaled signals.

    Parameters
    ----------
    nominal : control.StateSpace
        In physical units.
    scaled_nominal : control.StateSpace
        Between scaled inputs and outputs, where the weights act.
    left, right : control.StateSpace
        ``E = left Delta right`` with ``||Delta|| <= 1``, in the form of the uncertain model.
    """

    nominal: Any
    scaled_nominal: Any
    left: Any
    right: Any


def to_control(
    system: StateSpace,
    *,
    name: str | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> Any:
    """Return a system as `control.StateSpace`, or a batch as a list of them.

    Parameters
    ----------
    system : StateSpace
        Of `kros.core`, for example the controller of a `kros.synthesis` result; discrete, or continuous where its ``dt`` is zero.
    name : str, optional
    states, inputs, outputs : sequence of str, optional
        Names of the signals; python-control's own where absent. It allows no dots in names: ``0.5*x`` becomes ``0·5*x``.

    Returns
    -------
    control.StateSpace, or nested list of them
        One list level for each batch axis.

    Raises
    ------
    DimensionError
        As many names as signals are needed.

    Examples
    --------
    >>> from kros.core import StateSpace
    >>> from kros.interop import from_control, to_control
    >>> system = to_control(StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01), states=["position"], inputs=["target"])
    >>> system.state_labels, system.input_labels, system.dt
    (['position'], ['target'], 0.01)
    >>> from_control(system).A
    array([[0.5]])
    """
    if system.batch_shape:
        return [to_control(system[i], name=name, states=states, inputs=inputs, outputs=outputs) for i in range(system.batch_shape[0])]
    counts = {"states": system.n_states, "inputs": system.n_inputs, "outputs": system.n_outputs}
    signals = {"states": states, "inputs": inputs, "outputs": outputs}
    for kind, names in signals.items():
        if names is not None and (isinstance(names, str) or len(names) != counts[kind] or len(set(names)) != counts[kind]):
            raise DimensionError(f"to_control: {counts[kind]} {kind} need as many different names, found {names!r}; correct the list.")
    labels = {kind: [_label(text) for text in names] for kind, names in signals.items() if names}
    # Copies: python-control changes matrices in place where it is asked to. States that do nothing stay, since they carry names.
    matrices = [np.array(getattr(system, matrix)) for matrix in "ABCD"]
    return control.StateSpace(*matrices, system.dt, remove_useless_states=False, name=name and _label(name), **labels)


def from_control(system: Any) -> StateSpace:
    """Return a discrete `control.StateSpace` as a system of kros.

    Parameters
    ----------
    system : control.StateSpace
        With a sampling period in seconds. Names of its signals are not kept.

    Returns
    -------
    StateSpace

    Raises
    ------
    DimensionError
        Continuous time, no or an unspecified sampling period, or no state space.
    """
    if not isinstance(system, control.StateSpace):
        raise DimensionError(
            f"from_control: needs a control.StateSpace, found {type(system).__name__}; convert it with control.ss(system)."
        )
    dt = system.dt
    if dt is None or dt is True:
        raise DimensionError(
            f"from_control: the sampling period is not known (dt = {dt}); give it in seconds, control.ss(A, B, C, D, 0.001)."
        )
    if not dt > 0:
        raise DimensionError(
            f"from_control: the system is continuous (dt = {dt}); sample it with control.sample_system(system, 0.001) or another period."
        )
    A, B, C, D = (np.array(getattr(system, matrix), dtype=float) for matrix in "ABCD")
    return StateSpace(A, B, C, D, float(dt))


def models_to_control(models: ModelSet, units: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the models of units as `control.StateSpace`, from inputs to lifted states, by unit.

    Parameters
    ----------
    models : ModelSet
    units : sequence of str, optional
        Default: all.

    Returns
    -------
    dict of str to control.StateSpace
        States and outputs are named after the lifted functions, the system after the unit.

    Raises
    ------
    DimensionError
        An unknown unit.
    """
    asked = models.unit_ids if units is None else tuple(units)
    unknown = [unit for unit in asked if unit not in models.unit_ids]
    if unknown or isinstance(units, str):
        raise DimensionError(f"models_to_control: asked for units {units!r}, the models are of {list(models.unit_ids)}; correct the list.")
    systems = models.systems(asked)
    names = models.lifting.names
    return {unit: to_control(systems[i], name=unit, states=names, inputs=models.inputs, outputs=names) for i, unit in enumerate(asked)}


def uncertainty_to_control(model: UncertainModel) -> UncertaintyForControl:
    """Return the nominal and the weights of an uncertain model as `control.StateSpace`.

    Parameters
    ----------
    model : UncertainModel

    Returns
    -------
    UncertaintyForControl
    """
    return UncertaintyForControl(
        nominal=to_control(model.nominal_system, name="nominal"),
        scaled_nominal=to_control(model.scaled_nominal(), name="scaled_nominal"),
        left=to_control(model.weight.left, name="weight_left"),
        right=to_control(model.weight.right, name="weight_right"),
    )


def _label(name: str) -> str:
    """Return a name without dots, which separate system and signal in python-control: ``sin(0·5*x)`` for ``sin(0.5*x)``."""
    return name.replace(".", "·")
