"""Systems to and from python-control, with the names of their signals.

kros.core.StateSpace (a batch) ── to_control ──► control.StateSpace (a list) ── from_control ──► kros.core.StateSpace
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import DataError, DimensionError, MissingDependencyError
from ..core.lti import StateSpace
from ..identify import ModelSet
from ..uncertainty import ResponseUncertainty, UncertainModel

try:
    import control
except ImportError as error:
    raise MissingDependencyError(
        "kros.interop.control needs python-control, which is not installed; install it (pip install 'kros[control]')."
    ) from error


@dataclass(frozen=True, eq=False)
class UncertaintyForControl:
    """A nominal and weights: models have ``E = left Delta right``, ``||Delta|| <= 1`` in the form.

    Parameters
    ----------
    nominal : control.StateSpace or control.FRD
        In physical units; response data where the models were.
    scaled_nominal : control.StateSpace or control.FRD
        Between scaled inputs and outputs, where the weights act.
    left, right : control.StateSpace
        Stable and minimum phase, in the time of the models.
    remainder_left, remainder_right : control.StateSpace or None
        Weights of an additive part that joins the set where the form does not reach every model.
    model : UncertainModel or ResponseUncertainty
        Bounds of all forms, cover, misfit, names.
    certificate : str
        Where the bound is known to hold.

    Examples
    --------
    >>> import control
    >>> import kros
    >>> from kros.interop import uncertainty_to_control
    >>> lags = [control.ss([[pole]], [[1 - pole]], [[1]], [[0]], 0.01) for pole in (0.88, 0.9, 0.91)]
    >>> found = uncertainty_to_control(kros.quantify(lags, "additive"))
    >>> found.model.nominal_id, found.nominal.ninputs, found.left.dt
    ('1', 1, 0.01)
    """

    nominal: Any
    scaled_nominal: Any
    left: Any
    right: Any
    remainder_left: Any
    remainder_right: Any
    model: UncertainModel | ResponseUncertainty
    certificate: str


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
        Of `kros.core`, for example the controller of a `kros.synthesis` result; discrete, or continuous where its
        ``dt`` is zero.
    name : str, optional
    states, inputs, outputs : sequence of str, optional
        Names of the signals; python-control's own where absent. It allows no dots in names: ``0.5*x`` becomes
        ``0·5*x``.

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
    >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01)
    >>> system = to_control(lag, states=["position"], inputs=["target"])
    >>> system.state_labels, system.input_labels, system.dt
    (['position'], ['target'], 0.01)
    >>> from_control(system).A
    array([[0.5]])
    """
    if system.batch_shape:
        return [
            to_control(system[i], name=name, states=states, inputs=inputs, outputs=outputs)
            for i in range(system.batch_shape[0])
        ]
    counts = {"states": system.n_states, "inputs": system.n_inputs, "outputs": system.n_outputs}
    signals = {"states": states, "inputs": inputs, "outputs": outputs}
    for kind, names in signals.items():
        if names is not None and (
            isinstance(names, str) or len(names) != counts[kind] or len(set(names)) != counts[kind]
        ):
            raise DimensionError(
                f"to_control: {counts[kind]} {kind} need as many different names, found {names!r}; correct the list."
            )
    labels = {kind: [_label(text) for text in names] for kind, names in signals.items() if names}
    # Copies: python-control may change matrices in place. States that do nothing stay, since they carry names.
    matrices = [np.array(getattr(system, matrix)) for matrix in "ABCD"]
    return control.StateSpace(*matrices, system.dt, remove_useless_states=False, name=name and _label(name), **labels)


def from_control(system: Any) -> StateSpace:
    """Return a system of python-control as one of kros, continuous where ``dt`` is zero.

    Parameters
    ----------
    system : control.StateSpace or control.TransferFunction
        With a sampling period in seconds, or continuous. Entries of a transfer function get states of their own.

    Returns
    -------
    StateSpace

    Raises
    ------
    DimensionError
        An unspecified sampling period, or neither of the two.
    DataError
        An improper transfer function.

    Examples
    --------
    >>> import control
    >>> from kros.interop import from_control
    >>> from_control(control.tf([1.0], [1.0, -0.5], 0.01)).A.tolist()
    [[0.5]]
    """
    if not is_system(system):
        raise DimensionError(
            f"from_control: needs a control.StateSpace or control.TransferFunction, found {type(system).__name__}."
        )
    if system.dt is None or system.dt is True:
        raise DimensionError(
            f"from_control: the sampling period is not known (dt = {system.dt}); give it in seconds, control.ss(A, B, "
            "C, D, 0.001), or 0."
        )
    if isinstance(system, control.TransferFunction):
        return _realised(system)
    A, B, C, D = (np.array(getattr(system, matrix), dtype=float) for matrix in "ABCD")
    return StateSpace(A, B, C, D, float(system.dt))


def is_system(model: Any) -> bool:
    """Tell whether a model is known at every frequency."""
    return isinstance(model, (control.StateSpace, control.TransferFunction))


def _realised(model: Any) -> StateSpace:
    """A transfer function, entry by entry: no minimal realisation is needed for a frequency response."""
    from scipy.linalg import block_diag
    from scipy.signal import tf2ss

    p, m = model.noutputs, model.ninputs
    blocks, D = [], np.zeros((p, m))
    for i, j in np.ndindex(p, m):
        numerator, denominator = np.trim_zeros(model.num[i][j], "f"), np.trim_zeros(model.den[i][j], "f")
        if len(numerator) > len(denominator):
            raise DataError(
                f"from_control: entry ({i}, {j}) of the transfer function is improper; give a causal model."
            )
        if len(denominator) == 1 and numerator.size:
            D[i, j] = numerator[0] / denominator[0]
        elif numerator.size:
            a, b, c, d = tf2ss(numerator, denominator)
            D[i, j] = d[0, 0]
            blocks.append((a, b @ np.eye(m)[[j]], np.eye(p)[:, [i]] @ c))
    n = sum(len(a) for a, _, _ in blocks)
    A = block_diag(*(a for a, _, _ in blocks)) if blocks else np.zeros((0, 0))
    B = np.concatenate([np.zeros((0, m)), *(b for _, b, _ in blocks)])
    C = np.concatenate([np.zeros((p, 0)), *(c for _, _, c in blocks)], axis=1)
    return StateSpace(A.reshape(n, n), B, C, D, float(model.dt))


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

    Examples
    --------
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> models = kros.identify(motors, refine=False)
    >>> systems = kros.interop.models_to_control(models.sets["linear_edmd"])
    >>> len(systems), systems[motors.unit_ids[0]].input_labels
    (2, ['voltage'])
    """
    asked = models.unit_ids if units is None else tuple(units)
    unknown = [unit for unit in asked if unit not in models.unit_ids]
    if unknown or isinstance(units, str):
        raise DimensionError(
            f"models_to_control: asked for units {units!r}, the models are of {list(models.unit_ids)}; correct the "
            "list."
        )
    systems = models.systems(asked)
    names = models.lifting.names
    return {
        unit: to_control(systems[i], name=unit, states=names, inputs=models.inputs, outputs=names)
        for i, unit in enumerate(asked)
    }


def uncertainty_to_control(model: UncertainModel | ResponseUncertainty) -> UncertaintyForControl:
    """Return nominal and weights as `control.StateSpace`, a nominal response as `control.FRD`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace
    >>> from kros.interop import uncertainty_to_control
    >>> from kros.uncertainty import quantify
    >>> poles = np.array([0.88, 0.9, 0.91])[:, None, None]
    >>> units = StateSpace(poles, 1 - poles, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
    >>> uncertainty_to_control(quantify(units, "additive")).nominal.dt
    0.01
    """
    if isinstance(model, UncertainModel):
        nominal, scaled = (
            to_control(model.nominal_system, name="nominal"),
            to_control(model.scaled_nominal(), name="scaled_nominal"),
        )
        certificate = "for the systems on the unit circle, checked between the points of the grid and at its ends"
    else:
        G, certificate = model.nominal_response, model.certificate
        nominal, scaled = (
            control.FRD(np.moveaxis(g, 0, -1), 2 * np.pi * model.freqs_hz, model.sample_period_s)
            for g in (G, G / model.output_scale[:, None] * model.input_scale)
        )
    extra = model.remainder
    return UncertaintyForControl(
        nominal=nominal,
        scaled_nominal=scaled,
        left=to_control(model.weight.left, name="weight_left"),
        right=to_control(model.weight.right, name="weight_right"),
        remainder_left=None if extra is None else to_control(extra.left, name="remainder_left"),
        remainder_right=None if extra is None else to_control(extra.right, name="remainder_right"),
        model=model,
        certificate=certificate,
    )


def _label(name: str) -> str:
    """Return a name without dots, which separate system and signal: ``sin(0·5*x)`` for ``sin(0.5*x)``."""
    return name.replace(".", "·")
