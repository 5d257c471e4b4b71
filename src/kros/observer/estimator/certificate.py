r"""What is certain about a filter bank at run time: nothing that it estimates is fed back.

While measurements arrive, the error of its estimate is the residual of its regression on what was recorded, plus what
the filters make of noise,

.. math:: e_{k+1} = \omega_k - \sum_i F_i\, n_{k-i}, \qquad
          \|e\|_2 \le \gamma\, (\|\omega\|_2^2 + \|n\|_2^2)^{1/2},

with :math:`\gamma` the H-infinity norm of [1, F], signals divided by their sizes. It holds for every machine and has
no assumption on slopes for noise that lifted functions do not feel. The bound for recorded signals is the largest
error in an episode that was left out of the regression with its unit and all episodes of its name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...core import Array, StateSpace, SynthesisError, hinf_norm
from ...lifting import Lifting
from ..certificate.certificate import ReliftCertificate, ReliftStatus
from ..certificate.error import ReliftScales
from ..certificate.signals import SignalBound
from ..data import ObserverData
from ..sensor import delay_of
from ..sensor_gains import noise_response
from .channels import CONSTANT, without_limits

ASSUMPTIONS = (
    "the machine and the observer have the same inputs",
    "machine and observer lift with the same parameters",
    "every measurement arrives",
    "noise is small enough for lifted functions not to change",
)


def linear_part(observer: ObserverData, modelled: Lifting) -> tuple[StateSpace, Array, list[str]]:
    """Return the estimate of a model's lifted states from its (y, x, u), a strictly causal system, and what it misses.

    Of x only functions of measured states are read, as the lifted states that models know them by. It misses the mean
    (n,), which the constant channel leaves when everything else is at rest, and the channels that models have no signal
    for, which are named.

    Raises
    ------
    SynthesisError
        When measurements arrive late.
    """
    assert observer.bank is not None
    own, n, q = observer.lifting, len(observer.recorded), len(observer.measured)
    if delay_of(observer.sensor):
        raise SynthesisError("measurements arrive late, and the set contains no delay.")
    size, first = n + observer.bank.filters, q + modelled.n_states
    weights = np.hstack([observer.A, observer.B])[:size]
    signals = _signals(modelled, observer.inputs)
    B, constant, unknown = np.zeros((size, first + len(signals))), np.zeros(size), list[str]()
    B[:, :q] = weights[:, list(observer.measured)]
    for text, column in zip(_signals(own, observer.inputs), weights[:, own.n_states :].T, strict=True):
        if text in signals:
            B[:, first + signals.index(text)] = column
        elif text == CONSTANT:
            constant = column
        elif column.any():
            unknown.append(text)
    A = weights[:, :size].copy()
    A[:, list(observer.measured)] = 0.0  # measurements stand there
    C = np.eye(modelled.n_lifted, size) * (np.arange(modelled.n_lifted) < n)[:, None]
    mean = C @ np.linalg.solve(np.eye(size) - A, constant)
    return StateSpace(A, B, C, np.zeros((len(C), B.shape[1])), observer.sample_period_s), mean, unknown


def linear_estimate(observer: ObserverData, modelled: Lifting) -> tuple[StateSpace, Array]:
    """Return `linear_part` with its mean, or say why a certificate for the set of plants cannot follow from it."""
    system, mean, unknown = linear_part(observer, modelled)
    if unknown:
        more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
        raise SynthesisError(f"the models have no signal {without_limits(unknown[0])}{more}.")
    return system, mean


def _signals(lifting: Lifting, inputs: Sequence[str]) -> list[str]:
    """Return the columns after the states of [theta(x); u; gamma(u, x)]."""
    functions, of_inputs = ([f.text for f in formulas] for formulas in (lifting.formulas, lifting.input_formulas))
    return [*functions, *inputs, *of_inputs]


def filter_certificate(observer: ObserverData, scales: ReliftScales) -> ReliftCertificate:
    """Return the certificate of a filter bank at run time."""
    n = len(observer.recorded)
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
        gain=gain,
        lower_bound=gain,
    )


def left_out_bound(
    observer: ObserverData, sizes: Array, units: Sequence[str], errors: Array, worst_percent: Mapping[str, float]
) -> SignalBound:
    """Return the bound on RMS errors, the largest of left-out units, beside the errors (units, n) of training."""
    worst = np.array([worst_percent[name] for name in observer.recorded]) * sizes / 100
    bound = np.maximum(worst, errors.max(axis=0)) + np.zeros_like(errors)  # one for all units
    return SignalBound(observer.recorded, tuple(units), bound, sizes)
