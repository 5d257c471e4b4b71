r"""What is certain about a filter bank as it runs: nothing that it estimates is fed back.

While measurements arrive, the error of its estimate is the residual of its regression on what was recorded, plus what the filters make of noise,

.. math:: e_{k+1} = \omega_k - \sum_i F_i\, n_{k-i}, \qquad
          \|e\|_2 \le \gamma\, (\|\omega\|_2^2 + \|n\|_2^2)^{1/2},

with :math:`\gamma` the H-infinity norm of [1, F], signals divided by their sizes. It holds for every machine and has no assumption on slopes for noise
that lifted functions do not feel. The bound for recorded signals is the largest error on a unit that was left out of the regression.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import hinf_norm
from ..certificate.certificate import ReliftCertificate
from ..certificate.error import ReliftScales
from ..certificate.signals import SignalBound
from ..certificate.status import ReliftStatus
from ..data import ObserverData

Array = npt.NDArray[np.float64]
ASSUMPTIONS = (
    "the machine and the observer have the same inputs",
    "machine and observer lift with the same parameters",
    "every measurement arrives",
    "noise is small enough for lifted functions not to change",
)


def noise_response(observer: ObserverData) -> StateSpace:
    """Return the system from the noise of measurements, (q), to the error of the recorded states, (n)."""
    assert observer.bank is not None
    n = len(observer.recorded)
    z, at = slice(n, n + observer.bank.filters), list(observer.measured)
    A = observer.A
    return StateSpace(A[z, z], A[z, :][:, at], A[:n, z], A[:n, at], observer.sample_period_s)


def filter_certificate(observer: ObserverData, scales: ReliftScales) -> ReliftCertificate:
    """Return the certificate of a filter bank as it runs."""
    began, n = time.perf_counter(), len(observer.recorded)
    noise = noise_response(observer)
    error = scales.error[:n, None]
    B = np.hstack([np.zeros((len(noise.A), n)), noise.B * scales.noise])
    D = np.hstack([np.diag(scales.residual[:n]), noise.D * scales.noise]) / error
    gain = hinf_norm(StateSpace(noise.A, B, noise.C / error, D, noise.dt))
    return ReliftCertificate(
        scales,
        ASSUMPTIONS,
        {},
        {},
        status=ReliftStatus.CERTIFIED,
        certified=True,
        gain=float(gain),
        mismatch_gain=0.0,
        lower_bound=float(gain),
        method="nothing is fed back: norm of the filters",
        solve_s=time.perf_counter() - began,
    )


def left_out_bound(
    observer: ObserverData, sizes: Array, units: Sequence[str], errors: Array, worst_percent: Mapping[str, float]
) -> SignalBound:
    """Return the bound on every state's RMS error: the largest on a unit that was left out, and beside it the errors (units, n) of training."""
    worst = np.array([worst_percent[name] for name in observer.recorded]) * sizes / 100
    bound = np.maximum(worst, errors.max(axis=0))
    each = np.repeat(bound[None], len(units), axis=0)
    return SignalBound(observer.recorded, tuple(units), bound, each, errors, np.zeros(len(sizes)), sizes)
