r"""The internal states of a predictor along recordings: a stand-in for states that are not recorded, and coordinates in which it is stable.

The error of an observer with internal states (`identify_predictor`) obeys the same equations as any other's, for *any* sequence that is taken as the
machine's own. One suggests itself: start it where the observer starts, and let what was recorded drive it through the observer's own rows,

.. math:: m_{k+1} = A_m \theta(x_k, m_k) + B_m u_k .

The one-step residual of these rows is then zero by definition, whatever the machine, and that of the recorded states' rows is what the model misses
that knows the past. It depends on the observer's rows, not on its gains.

The coordinates of internal states are free: ``m' = m - K x_h`` (x_h the hidden states) changes no estimate, and decides whether recordings drive them
stably. Let F be the rows of [x_h; m] and P their observability Gramian, ``P = F' P F + H' H``, H the hidden states over their sizes. With
``K = -P_mm^-1 P_mh`` the Gramian has no cross terms, so that

.. math:: P_{mm} = F_{mm}^\top P_{mm} F_{mm} + F_{hm}^\top (\cdot) F_{hm}

with something positive between: the internal dynamics ``F_mm`` is stable wherever F is.

Hidden states with limits (`limited`) are given, as measured ones are: F is then that of the others, the internal states that are these without
their limits shown in H beside x_h. Their gain is part of the coordinates, and decides what the observer does at its limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...core.norms import gramian
from ...data import EpisodeBatch
from ...loops import recursion
from ..data import ObserverData
from ..observer import Observer
from .limited import limited_states

Array = npt.NDArray[np.float64]
Parameters = Mapping[str, npt.ArrayLike]


def with_internal(
    observer: ObserverData,
    states: Array,
    inputs: Array,
    parameters: Parameters | None = None,
    start: Array | None = None,
    added: Array | None = None,
) -> Array:
    """Return recordings with the internal states that they drive behind them, shape (n_samples, batch, n)."""
    n, recorded = observer.lifting.n_states, len(observer.recorded)
    if states.shape[-1] == n:
        return states
    if states.shape[-1] != recorded:
        raise DimensionError(
            f"Internal states of observer {observer.name}: they are driven by the {recorded} states {', '.join(observer.recorded)}, found {states.shape[-1]}."
        )
    values = {**observer.parameters, **(parameters or {})} if observer.lifting.parameters else None
    rows, into = observer.A[recorded:n], observer.B[recorded:n]
    driven = np.zeros((*states.shape[:2], n))
    driven[..., :recorded] = states
    first = observer.initial(states[0][:, list(observer.measured)], values) if start is None else start
    driven[0, :, recorded:] = first[:, recorded:]
    outside = [*range(recorded), *range(n, observer.lifting.n_lifted)]
    signals, gains = [observer.lifting.lift(driven, values)[..., outside], inputs], [rows[:, outside], into]
    if added is not None:
        apart = np.zeros((*states.shape[:2], n - recorded))
        apart[: len(added)] = added[: len(apart), :, recorded:]
        signals, gains = [*signals, apart], [*gains, np.eye(n - recorded)]
    drive = np.concatenate(signals, axis=-1)
    driven[..., recorded:] = recursion(rows[:, recorded:n], drive, driven[0, :, recorded:], np.hstack(gains))
    return driven


def driven_coordinates(observer: Observer, batch: EpisodeBatch, sizes: npt.ArrayLike) -> Observer:
    """Return the observer with internal states in coordinates in which recordings drive them stably, of RMS one."""
    recorded, n = len(observer.recorded), observer.lifting.n_states
    if recorded == n or not observer.replaces:
        return observer
    limited = limited_states(observer)
    hidden = [i for i in range(recorded) if i not in observer.measured and i not in limited]
    place, h = [*hidden, *range(recorded, n)], len(hidden)
    F = observer.A[np.ix_(place, place)]
    if not np.abs(np.linalg.eigvals(F)).max() < 1:
        return observer
    shown = [*range(h), *range(len(F) - len(limited), len(F))]
    H = np.zeros((len(shown), len(F)))
    H[range(len(shown)), shown] = 1 / np.asarray(sizes, dtype=float)[[*hidden, *limited]]
    P = gramian(F.T, H.T, 1.0)
    turn = np.eye(observer.lifting.n_lifted)
    turn[recorded:n, hidden] = np.linalg.lstsq(P[h:, h:], P[h:, :h], rcond=None)[0]
    turned = in_coordinates(observer, turn)
    internal = with_internal(turned, batch.states, batch.inputs, turned.own(batch.parameters))[..., recorded:]
    size = np.sqrt(np.mean(internal**2, axis=(0, 1)))
    scale = np.eye(len(turn))
    scale[range(recorded, n), range(recorded, n)] = np.divide(1.0, size, out=np.ones_like(size), where=size > 0)
    return in_coordinates(turned, scale)


def in_coordinates(observer: Observer, turn: Array) -> Observer:
    """The observer in lifted coordinates ``turn @ theta`` that leave the recorded states and the lifted functions alone."""
    n = observer.lifting.n_states
    A, start = (
        turn @ observer.A @ np.linalg.inv(turn),
        None if observer.start_in_motion is None else observer.start_in_motion.turned(turn[:n, :n]),
    )
    guard, controller = observer.guard, replace(observer.controller, D=A[:, list(observer.measured)])
    guard = None if guard is None else guard.turned(turn[:n, :n])
    return replace(observer, A=A, B=turn @ observer.B, start_in_motion=start, controller=controller, guard=guard)
