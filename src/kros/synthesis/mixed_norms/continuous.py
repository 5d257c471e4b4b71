r"""Mixed synthesis in continuous time: the same problem in discrete time, exactly.

The bilinear map ``s = a (z - 1) / (z + 1)`` keeps gains and stability, but not H2 norms: with ``w = a tan(theta / 2)`` and a strictly proper T

.. math:: \frac{1}{2\pi}\int |T(jw)|^2\,dw = \frac{1}{2\pi}\int_{-\pi}^{\pi} \Big|\sqrt{a/2}\,(1 + s/a)\,T\Big|^2 d\theta .

So z1 becomes ``sqrt(a/2) (z1 + z1' / a)``. It needs the derivative of u; therefore u becomes a state, driven by ``v = u + u' / a``, and the
controller from y to v is any proper one exactly where that from y to u is any strictly proper one, which a finite H2 norm asks for anyway.

Symbols
-------
a : speed in rad/s, the geometric mean of the plant's poles;  K : controller from y to v;  u : ``v / (1 + s/a)``
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import to_continuous
from ..generalized_plant import GeneralizedPlant, split
from ..riccati.hinf_coordinates import to_discrete


def speed(plant: GeneralizedPlant) -> float:
    """Return the geometric mean of the poles that are not at zero, rad/s."""
    sizes = np.abs(np.linalg.eigvals(plant.A))
    sizes = sizes[sizes > 1e-9 * sizes.max(initial=0.0)]
    return float(np.exp(np.log(sizes).mean())) if sizes.size else 1.0


def discrete_twin(plant: GeneralizedPlant, a: float) -> GeneralizedPlant:
    """Return the discrete plant from (w, v) to (z, y) whose channels have the norms of the continuous one."""
    n, n_w, n_u, n_z, n_y = plant.sizes
    A, B1, B2 = plant.A / a, plant.B1 / a, plant.B2 / a
    one, two = plant.rows(1), plant.rows(2)
    C1, D11, D12 = np.zeros((n_z, n + n_u)), np.zeros((n_z, n_w)), np.zeros((n_z, n_u))
    root = np.sqrt(a / 2)
    C1[one] = root * np.hstack([plant.C1[one] @ (np.eye(n) + A), plant.C1[one] @ B2])
    D11[one], D12[one] = root * plant.C1[one] @ B1, root * plant.D12[one]
    C1[two], D11[two] = np.hstack([plant.C1[two], plant.D12[two]]), plant.D11[two]
    system = StateSpace(
        np.block([[A, B2], [np.zeros((n_u, n)), -np.eye(n_u)]]),
        np.block([[B1, np.zeros((n, n_u))], [np.zeros((n_u, n_w)), np.eye(n_u)]]),
        np.vstack([C1, np.hstack([plant.C2, plant.D22])]),
        np.block([[D11, D12], [plant.D21, np.zeros((n_y, n_u))]]),
        0.0,
    )
    return split(to_discrete(system, 1.0), n_w, n_z, n_w1=plant.n_w1, n_z1=plant.n_z1)


def continuous_controller(K: StateSpace, a: float) -> StateSpace:
    """Return the strictly proper controller from y to u for one from y to v of the discrete twin.

    Raises
    ------
    SynthesisError
        When K has a pole at z = -1.
    """
    try:
        K = to_continuous(K)
    except np.linalg.LinAlgError as error:
        raise SynthesisError(
            "Mixed synthesis: the controller has a pole at infinity; add penalty or noise, or scale time so that the plant's poles are near one."
        ) from error
    eye = np.eye(K.n_outputs)
    K = StateSpace(-eye, eye, eye, np.zeros_like(eye), 0.0) @ K
    return replace(K, A=a * K.A, B=a * K.B)
