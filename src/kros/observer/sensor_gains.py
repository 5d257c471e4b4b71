r"""What sensor an observer needs: what errors of its measurements cost in its estimates, in closed form.

With G from a measurement's error to a state's, of the observer's linear part,

.. math:: \mathrm{white\ noise}: \|G\|_2, \qquad \mathrm{bias}: |G(1)|, \qquad \mathrm{bounded}: \sum_k |g_k|.

Lifted functions and a declared delay are left out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..core import AGREED, Array, StateSpace
from ..core.norms import gramian
from ..identify.free_run import recursion
from .data import ObserverData

BLOCK = 4096  # samples of an impulse response that are in memory
SLOWEST = 100_000  # samples: of a longer time constant, an impulse response is too long to sum


def noise_response(observer: ObserverData) -> StateSpace:
    """Return the system from the noise of measurements, (q), to the error of the recorded states, (n)."""
    n, q, at, dt = len(observer.recorded), len(observer.measured), list(observer.measured), observer.sample_period_s
    if observer.bank is not None:
        A, z = observer.A, slice(n, n + observer.bank.filters)
        return StateSpace(A[z, z], A[z, :][:, at], A[:n, z], A[:n, at], dt)
    step, n_lifted = observer.one_step, observer.lifting.n_lifted
    inside = [*range(n), *range(n_lifted, n_lifted + observer.controller.n_states)]
    return StateSpace(step[:, inside], step[:, -q:], np.eye(n, len(step)), np.zeros((n, q)), dt)


def sensor_gains(observer: ObserverData, sizes: Mapping[str, float]) -> dict[str, dict[str, dict[str, float]]]:
    """Return gains by measurement, kind of error and state, both in shares of `sizes`; none where it hardly forgets."""
    system, states = noise_response(observer), observer.recorded
    if float(system.spectral_radius()) > 1 - 1 / SLOWEST:
        return {}
    A, B, C, D = system.A, system.B, system.C, system.D
    white = [np.diag(C @ gramian(A, b[:, None], system.dt) @ C.T) + d**2 for b, d in zip(B.T, D.T, strict=True)]
    gains = {
        "noise": np.sqrt(np.transpose(white)),
        "bias": np.abs(system.frequency_response([0.0])[0]),
        "bounded": _bounded(system),
    }
    return {
        states[i]: {
            kind: {s: float(g * sizes[states[i]] / sizes[s]) for s, g in zip(states, of[:, column], strict=True)}
            for kind, of in gains.items()
        }
        for column, i in enumerate(observer.measured)
    }


def _bounded(system: StateSpace) -> Array:
    """Return the sums of absolute impulse responses, shape (n, q)."""
    x, total, still = system.B.T, np.abs(system.D.T), np.zeros((BLOCK, system.n_inputs, system.n_inputs))
    while True:
        states = recursion(system.A, system.B, x, still)
        added = np.abs(states @ system.C.T).sum(axis=0)
        total, x = total + added, states[-1] @ system.A.T
        if np.all(added <= AGREED * total):
            return total.T
