"""Systems to and from python-control, with the names of their signals.

kros.core.StateSpace (a batch) ── to_control ──► control.StateSpace (a list) ── from_control ──► kros.core.StateSpace
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core import DataError, DimensionError, MissingDependencyError, StateSpace, block_diagonal, gain

try:
    import control
except ImportError as error:
    text = "kros.interop.control needs python-control; install it, pip install 'kros[control]'."
    raise MissingDependencyError(text) from error


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
    signals = {"states": states, "inputs": inputs, "outputs": outputs}
    if system.batch_shape:
        return [to_control(system[i], name=name, **signals) for i in range(system.batch_shape[0])]
    for (kind, names), count in zip(signals.items(), (system.n_states, system.n_inputs, system.n_outputs), strict=True):
        if names is not None and (isinstance(names, str) or not len(names) == len(set(names)) == count):
            raise DimensionError(f"to_control: {count} {kind} need as many different names, found {names!r}.")
    labels = {kind: [_label(text) for text in names] for kind, names in signals.items() if names}
    # Copies: python-control may change matrices in place. States that do nothing stay, since they carry names.
    matrices = map(np.array, system.matrices)
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
    if not isinstance(system, control.StateSpace | control.TransferFunction):
        kind = type(system).__name__
        raise DimensionError(f"from_control: needs a control.StateSpace or control.TransferFunction, found {kind}.")
    if system.dt is None or system.dt is True:
        unknown = f"the sampling period is not known (dt = {system.dt})"
        raise DimensionError(f"from_control: {unknown}; give it in seconds, control.ss(A, B, C, D, 0.001), or 0.")
    if isinstance(system, control.TransferFunction):
        return _realised(system)
    A, B, C, D = (np.array(getattr(system, matrix), dtype=float) for matrix in "ABCD")
    return StateSpace(A, B, C, D, float(system.dt))


def _realised(model: Any) -> StateSpace:
    """Realise a transfer function, entry by entry: a frequency response needs no minimal realisation."""
    p, m, dt = model.noutputs, model.ninputs, float(model.dt)
    try:
        entries = block_diagonal([from_control(control.ss(model[i, j])) for i, j in np.ndindex(p, m)])
    except ValueError as error:
        raise DataError("from_control: an entry of the transfer function is improper; give a causal model.") from error
    return gain(np.kron(np.eye(p), np.ones(m)), dt) @ entries @ gain(np.tile(np.eye(m), (p, 1)), dt)


def _label(name: str) -> str:
    """Return a name without dots, which separate system and signal: ``sin(0·5*x)`` for ``sin(0.5*x)``."""
    return name.replace(".", "·")
