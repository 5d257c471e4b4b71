r"""Certificate of an observer at run time: retracted and re-lifted at every step.

For every true trajectory and every sequence of measurement noise, whatever machine they come from,

.. math:: \sum_k |e_k|^2 \le \gamma^2 \sum_k \left(|\omega_k|^2 + |n_k|^2\right) + V(e_0),

with the signals divided by their sizes (`ReliftScales`), omega the one-step residual and n the noise. A Riccati
equation with multipliers proposes; what is returned was proven in exact arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from enum import Enum

import numpy as np

from ...core import Array, Names, Storable, frozen
from ...lifting.intervals import Box
from ..data import ObserverData
from ..units import factors
from .error import ErrorSystem, ReliftScales, UnboundedSlopeError, error_system, state_sizes
from .proof import first_proof, frozen_gain, growing_place


class ReliftStatus(str, Enum):
    """What happened, and what to change.

    CERTIFIED
        The gain is proven.
    UNSTABLE
        Slopes that stay at a corner of the box, or in its middle, make the error grow without bound in the model: there
        is no certificate for this observer over this box. Take a smaller box, weaken the correction, or use another
        model.
    UNBOUNDED
        A lifted function may be arbitrarily steep. Name a box of states (and inputs) in which the observer works.
    NOT_FOUND
        Neither a proof nor a counterexample was found. Take a smaller box.

    Examples
    --------
    >>> from kros.observer import ReliftStatus
    >>> [status.value for status in ReliftStatus]
    ['certified', 'unstable', 'unbounded', 'not_found']
    """

    CERTIFIED = "certified"
    UNSTABLE = "unstable"
    UNBOUNDED = "unbounded"
    NOT_FOUND = "not_found"


@frozen
class ReliftCertificate(Storable):
    """What is proven about an observer at run time.

    Parameters
    ----------
    scales : ReliftScales
    assumptions : tuple of str
        What has to hold, in words.
    box, parameters : mapping of str to (lower, upper)
        Ranges of states, inputs and parameters that it holds for; see `relift_certificate`.
    status : ReliftStatus
    reason : str
        A sentence; empty where the gain is proven.
    gain : float or None
        gamma, in the units of `scales`.
    lower_bound : float or None
        Gain that a frozen slope attains: no certificate of any kind is below it.
    start : ndarray, shape (n_xi, n_window)
        Where the first error enters.
    root : ndarray, shape (n_xi, n_xi)
        Upper triangular factor of the Lyapunov matrix, ``P = R'R``.
    multipliers : ndarray, shape (n_p,)
        Of the slopes.
    channels : tuple of str
        Slopes that move.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, relift_certificate
    >>> lifting, A = Lifting(("x",), ("sin(x)",)), np.array([[0.5, 0.2], [0, 0]])
    >>> plant = Observer.open_loop("x", lifting, A, np.ones((2, 1)), (0,), ("u",), 1.0)
    >>> certificate = relift_certificate(plant)
    >>> certificate.certified, certificate.status.value, certificate.lower_bound <= certificate.gain
    (True, 'certified', True)
    """

    KIND = "relift"
    scales: ReliftScales
    assumptions: Names
    box: Mapping[str, float | tuple[float, float] | Array]
    parameters: Mapping[str, float | tuple[float, float] | Array]
    status: ReliftStatus = ReliftStatus.UNBOUNDED
    reason: str = ""
    gain: float | None = None
    lower_bound: float | None = None
    start: Array = field(default_factory=lambda: np.zeros((0, 0)))
    root: Array = field(default_factory=lambda: np.zeros((0, 0)))
    multipliers: Array = field(default_factory=lambda: np.zeros(0))
    channels: Names = ()

    @property
    def certified(self) -> bool:
        """Whether the gain is proven."""
        return self.status is ReliftStatus.CERTIFIED

    def system(self, observer: ObserverData) -> ErrorSystem:
        """Return the error dynamics that the certificate is about."""
        return error_system(observer, self.scales, self.box, self.parameters)

    def in_units(self, observer: ObserverData) -> ReliftCertificate:
        """Return what the certificate of an observer says of the same observer in the units of the recordings."""
        x, u = factors(observer, {})
        n, lifting = observer.lifting.n_states, observer.lifting
        names = (*lifting.states, *observer.inputs)
        by_name = dict(zip(names, np.concatenate([x[:n], u[: len(observer.inputs)]]), strict=True))
        errors = [by_name[name] for name, _ in lifting.window.quantities if name in lifting.states]
        y = x[list(observer.measured)]
        scales = ReliftScales(self.scales.error * x[:n], self.scales.residual * x[:n], self.scales.noise * y)
        box = {name: tuple(np.multiply(value, by_name.get(name, 1.0)).tolist()) for name, value in self.box.items()}
        root = self.root / state_sizes(observer, self.scales, np.array(errors)) if self.root.size else self.root
        assumptions = _assumptions(observer, box, self.parameters)
        return replace(self, scales=scales, box=box, assumptions=assumptions, root=root)

    def __repr__(self) -> str:
        """Say what is proven, in a line."""
        proven = f"gain {self.gain:.4g} (at least {self.lower_bound:.4g})" if self.certified else ""
        return f"<ReliftCertificate {proven or f'{self.status.value}: {self.reason}'}>"


def relift_certificate(
    observer: ObserverData, box: Box | None = None, scales: ReliftScales | None = None, parameters: Box | None = None
) -> ReliftCertificate:
    """Certify an observer at run time, with any lifting of bounded slopes and any correction.

    Parameters
    ----------
    observer : ObserverData
        With the delay and limits that its `runtime` declares.
    box : mapping of str to (lower, upper), optional
        Ranges of states (and of inputs, for input functions) inside which true and estimated values stay; needed where
        slopes have no global bound.
    scales : ReliftScales, optional
        Sizes of errors, residuals and noise; one by default, which leaves physical units.
    parameters : mapping of str to number or (lower, upper), optional
        Ranges of the lifting's parameters; any value by default, so that the certificate holds for every unit.

    Returns
    -------
    ReliftCertificate
        Also where nothing could be proven: `certified` is false, and `status` and `reason` say why.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, relift_certificate
    >>> lifting, A = Lifting(("x",), ("sin(x)",)), np.array([[0.5, 0.2], [0, 0]])
    >>> plant = Observer.open_loop("x", lifting, A, np.ones((2, 1)), (0,), ("u",), 1.0)
    >>> # x+ = 0.5 x + 0.2 sin(x) + u: the error shrinks at least by 0.7 a step
    >>> round(relift_certificate(plant).gain, 1)
    3.3
    """
    assumptions = _assumptions(observer, box, parameters)
    scales = scales or ReliftScales.ones(observer)
    result = ReliftCertificate(scales, assumptions, dict(box or {}), dict(parameters or {}))
    try:
        system = result.system(observer)
    except UnboundedSlopeError as error:
        return replace(result, status=ReliftStatus.UNBOUNDED, reason=f"No certificate: {error}.")
    result = replace(result, channels=system.channels, start=system.start)
    if growing := growing_place(system):
        return replace(result, status=ReliftStatus.UNSTABLE, reason=growing)
    proof = first_proof(system)
    if proof is None:
        reason = f"No Lyapunov function was found for all slopes in the box; {len(system.channels)} move."
        return replace(result, status=ReliftStatus.NOT_FOUND, reason=reason)
    return replace(
        result,
        status=ReliftStatus.CERTIFIED,
        gain=proof.gain,
        lower_bound=frozen_gain(system),
        root=proof.root,
        multipliers=proof.multipliers,
    )


def _assumptions(observer: ObserverData, box: Box | None, parameters: Box | None) -> Names:
    """Return what has to hold, in words."""
    found = ["the machine and the observer have the same inputs", "machine and observer lift with the same parameters"]
    if parameters:
        found.append(f"parameters within {_ranges(parameters)}")
    elif observer.lifting.parameters:
        found.append(f"any value of {', '.join(observer.lifting.parameters)}")
    if box:
        found.append(f"true and estimated state stay within {_ranges(box)}")
    found.append("every measurement arrives")
    limits, names = observer.runtime, observer.lifting.states
    limited = np.isfinite(limits.sides(len(names))).any(axis=0)
    if limits.delay:
        found.append(f"measurements arrive {limits.delay} samples late")
    if clips := [names[i] for i in np.flatnonzero(limited)]:
        found.append(f"the true {', '.join(clips)} stays within the limits of the estimate")
    if observer.seen is not None:
        found.append("no measurement and no input is refused as implausible")
    return tuple(found)


def _ranges(box: Box) -> str:
    texts = []
    for name, value in box.items():
        low, high = value if np.ndim(value) else (value, value)
        texts.append(f"{name} in [{float(low):g}, {float(high):g}]")
    return ", ".join(texts)
