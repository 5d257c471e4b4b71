r"""The memory of an observer along recordings: what stands for states that nobody recorded, and coordinates in which it does so well.

The error of an observer with a memory (`remembering_observer`) obeys the same equations as any other's, for *any* sequence that is taken as the
machine's memory. One suggests itself: start it where the observer starts, and let what was recorded drive it through the observer's own rows,

.. math:: m_{k+1} = A_m \theta(x_k, m_k) + B_m u_k .

The one-step residual of these rows is then zero by definition, whatever the machine, and that of the recorded states' rows is what the model misses
that knows the past. Nothing of it depends on the observer's gains beyond its rows.

The coordinates of a memory are free: ``m' = m - K x_h`` (x_h the hidden states) changes no estimate, and decides whether recordings drive it
stably. Let F be the rows of [x_h; m] and P their observability Gramian, ``P = F' P F + H' H``, H the hidden states over their sizes. With
``K = -P_mm^-1 P_mh`` the Gramian has no cross terms, so that

.. math:: P_{mm} = F_{mm}^\top P_{mm} F_{mm} + F_{hm}^\top (\cdot) F_{hm}

with something positive between: the memory's own dynamics ``F_mm`` is stable wherever F is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...core.linalg import least_squares
from ...core.norms import gramian
from ..observer import Observer

Array = npt.NDArray[np.float64]
Parameters = Mapping[str, npt.ArrayLike]
_THIN, _SKIP = 4, 300


def with_memory(observer: Observer, states: Array, inputs: Array, parameters: Parameters | None = None) -> Array:
    """Return recordings with the memory that they drive behind them, shape (n_samples, batch, n).

    Parameters
    ----------
    observer : Observer
    states : ndarray, shape (n_samples, batch, n_recorded)
        Returned as they are where the observer has no memory.
    inputs : ndarray, shape (n_samples, batch, m)
    parameters : mapping of str to array_like, shape (batch,)

    Raises
    ------
    DimensionError
        When there are neither as many states as are recorded nor as many as the observer has.
    """
    n, recorded = observer.lifting.n_states, len(observer.recorded)
    if states.shape[-1] == n:
        return states
    if states.shape[-1] != recorded:
        raise DimensionError(
            f"Memory of observer {observer.name}: it is driven by the {recorded} states {', '.join(observer.recorded)}, found {states.shape[-1]}."
        )
    values = {**observer.parameters, **(parameters or {})} if observer.lifting.parameters else None
    rows, into = observer.A[recorded:n].T, observer.B[recorded:n].T
    driven = np.zeros((*states.shape[:2], n))
    driven[..., :recorded] = states
    driven[0, :, recorded:] = observer.initial(states[0][:, list(observer.measured)], values)[:, recorded:]
    constant = observer.lifting.lift(driven, values)
    constant[..., recorded:n] = 0.0
    drive, own = constant @ rows + inputs @ into, np.ascontiguousarray(rows[recorded:n])
    for k in range(len(states) - 1):
        driven[k + 1, :, recorded:] = driven[k, :, recorded:] @ own + drive[k]
    return driven


def driven_coordinates(
    observer: Observer, states: Array, inputs: Array, sizes: npt.ArrayLike, parameters: Parameters | None = None
) -> Observer:
    """Return the same observer with its memory in coordinates in which recordings drive it stably, each of RMS one along them.

    Parameters
    ----------
    observer : Observer
        Whose measurements take the place of estimates.
    states, inputs, parameters
        As in `with_memory`.
    sizes : array_like, shape (n_recorded,)
        Sizes of the recorded states.

    Returns
    -------
    Observer
        Of the same estimates; the observer itself where it has no memory, or is not stable.
    """
    recorded, n = len(observer.recorded), observer.lifting.n_states
    if recorded == n or not observer.replaces:
        return observer
    hidden = [i for i in range(recorded) if i not in observer.measured]
    place = [*hidden, *range(recorded, n)]
    F, h = observer.A[np.ix_(place, place)], len(hidden)
    if not np.abs(np.linalg.eigvals(F)).max() < 1:
        return observer
    H = np.zeros((h, len(F)))
    H[:, :h] = np.diag(1 / np.asarray(sizes, dtype=float)[hidden])
    P = gramian(F.T, H.T, 1.0)
    turn = np.eye(observer.lifting.n_lifted)
    turn[recorded:n, hidden] = np.linalg.lstsq(P[h:, h:], P[h:, :h], rcond=None)[0]
    turned = _in_coordinates(observer, turn)
    memory = with_memory(turned, states, inputs, parameters)[..., recorded:]
    size = np.sqrt(np.mean(memory**2, axis=(0, 1)))
    scale = np.eye(len(turn))
    scale[range(recorded, n), range(recorded, n)] = np.divide(1.0, size, out=np.ones_like(size), where=size > 0)
    return _in_coordinates(turned, scale)


def refit_measured_rows(observer: Observer, states: Array, inputs: Array, parameters: Parameters | None = None) -> Observer:
    """Return the observer with the measured states' rows fitted anew to single steps, on what it estimates itself.

    Where measurements take the place of estimates these rows decide nothing but the next measurement's prediction, hence what happens when
    measurements stop. They fit one memory, and not what tuning makes of it.

    Parameters
    ----------
    observer : Observer
        Whose measurements take the place of estimates.
    states, inputs, parameters
        As in `with_memory`.
    """
    if not observer.replaces:
        return observer
    lifting, measured = observer.lifting, list(observer.measured)
    n = lifting.n_states
    others = [i for i in range(n) if i not in measured]
    values = {**observer.parameters, **(parameters or {})} if lifting.parameters else None
    y = states[..., measured]
    estimate = observer.run(y, inputs, values)
    lifted = lifting.lift(estimate, values)[..., n:]
    seen = _rows(np.concatenate([estimate[..., others], y, inputs, lifted], axis=-1)[:-1])
    change = _rows(np.diff(y, axis=0))
    rows = least_squares(seen, change, rcond=1e-10).T
    own, at_y, at_u, at_lifted = np.split(rows, np.cumsum([len(others), y.shape[-1], inputs.shape[-1]]), axis=1)
    A, B, D = observer.A.copy(), observer.B.copy(), observer.controller.D.copy()
    A[np.ix_(measured, others)], A[np.ix_(measured, range(n, lifting.n_lifted))] = own, at_lifted
    A[np.ix_(measured, measured)] = D[measured] = at_y + np.eye(len(measured))
    B[measured] = at_u
    return replace(observer, A=A, B=B, controller=replace(observer.controller, D=D))


def _rows(values: Array) -> Array:
    """Samples of all episodes one below the other, thinned, without the first ones."""
    return values[_SKIP::_THIN].reshape(-1, values.shape[-1])


def _in_coordinates(observer: Observer, turn: Array) -> Observer:
    """The observer in lifted coordinates ``turn @ theta`` that leave the recorded states and the lifted functions alone."""
    A = turn @ observer.A @ np.linalg.inv(turn)
    return replace(observer, A=A, B=turn @ observer.B, controller=replace(observer.controller, D=A[:, list(observer.measured)]))
