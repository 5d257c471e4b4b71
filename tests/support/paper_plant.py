r"""The published generalized plant (37)-(39) of Figure 9 in its minimal form, in the error.

Three facts shape what kros does with it: it is not minimal (the copies of the plant and a static input weight drop out in
``e = x - x_hat``); it is singular (``D12 = 0``, ``D21 = 0``), so Riccati methods refuse it; and problem (7)-(8) is degenerate for it: ``T11 = 0``
for every stabilising K, since ``w1`` drives plant and observer alike, and ``T22`` does not contain K.

::

    w1 -> W_u -+------------------>(+)--> u_p -> x+ = A x + B u_p          z2 = W_u w1 + W_D w2
               |        w2 -> W_D --^                   |
               |                                        v
               +--------------->(+) -> x_hat+ = A x_hat + B (u + y^c)      z1 = W_p (x - x_hat),   y = C (x - x_hat)
                           y^c --^

In the paper's sentence after (10) the names of ``z2`` and ``w2`` are swapped; here ``w2 = Delta z2`` as in Figure 9.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kros.core.lti import StateSpace
from kros.synthesis.generalized_plant import GeneralizedPlant

Array = npt.NDArray[Any]


def reduced_plant(
    nominal: StateSpace, C: npt.ArrayLike, W_p: StateSpace, W_u: StateSpace, W_D: StateSpace
) -> GeneralizedPlant:
    """Transfer matrices of (37)-(39) in the error, states (e, x_p, x_u, x_D): `e+ = A e + B (C^D x_D + D^D w2) - B u`."""
    A, B, C = nominal.A, nominal.B, np.asarray(C, dtype=float)
    n, m, p, q = nominal.n_states, nominal.n_inputs, W_p.n_outputs, C.shape[0]
    k_p, k_u, k_d = W_p.n_states, W_u.n_states, W_D.n_states
    zero = np.zeros
    return GeneralizedPlant(
        np.block(
            [
                [A, zero((n, k_p + k_u)), B @ W_D.C],
                [W_p.B, W_p.A, zero((k_p, k_u + k_d))],
                [zero((k_u, n + k_p)), W_u.A, zero((k_u, k_d))],
                [zero((k_d, n + k_p + k_u)), W_D.A],
            ]
        ),
        np.block([[zero((n, m)), B @ W_D.D], [zero((k_p, 2 * m))], [W_u.B, zero((k_u, m))], [zero((k_d, m)), W_D.B]]),
        np.vstack([-B, zero((k_p + k_u + k_d, m))]),
        np.block([[W_p.D, W_p.C, zero((p, k_u + k_d))], [zero((m, n + k_p)), W_u.C, W_D.C]]),
        np.hstack([C, zero((q, k_p + k_u + k_d))]),
        np.block([[zero((p, 2 * m))], [W_u.D, W_D.D]]),
        zero((p + m, m)),
        zero((q, 2 * m)),
        zero((q, m)),
        nominal.dt,
        n_w1=m,
        n_z1=p,
    )
