r"""Certificate of an observer as it runs: retracted and re-lifted at every step.

For every true trajectory and every sequence of measurement noise, whatever machine they come from,

.. math:: \sum_k |e_k|^2 \le \gamma^2 \sum_k \left(|\omega_k|^2 + |n_k|^2\right) + V(e_0),

with the signals divided by their sizes (`ReliftScales`), omega the one-step residual and n the noise. A second number says how far the error can be from
its *frozen response* e', the linear response to the same omega and n with every slope in the middle of its interval:

.. math:: \|e - e'\|_2 \le \kappa \, \|q'\|_2,    q' = M e' the largest movement of the lifted functions that e' can cause.

Since e' is computed for the residual as it was, this bound uses its whole course, and not its energy alone. A Riccati equation
with multipliers proposes; what is returned was proven in exact arithmetic.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import load_artifact, loader, save_artifact
from ..data import ObserverData
from ..units import factors
from .error import Box, ErrorSystem, ReliftScales, UnboundedSlopeError, error_system, state_sizes
from .search import MOST_CORNERS, frozen_gain, mismatch_gain, prove
from .status import ReliftStatus

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ReliftCertificate:
    """What is proven about an observer as it runs.

    Parameters
    ----------
    scales : ReliftScales
    assumptions : tuple of str
        What has to hold, in words.
    box, parameters : mapping of str to (lower, upper)
        What was asked; see `relift_certificate`.
    status : ReliftStatus
    reason : str
        A sentence; empty where the gain is proven.
    certified : bool
    gain : float or None
        gamma, in the units of `scales`.
    mismatch_gain : float or None
        kappa; 0 where no slope moves, None where it was not found or not asked for.
    lower_bound : float or None
        Gain that a frozen slope attains: no certificate of any kind is below it.
    start : ndarray, shape (n_xi, n_window)
        Where the first error enters.
    roots : ndarray, shape (1, n_xi, n_xi)
        Upper triangular factor of the Lyapunov matrix, ``P = R'R``.
    corners : ndarray, shape (n_corners, n_p)
        Places of the slopes in their intervals, -1 or 1.
    multipliers : ndarray, shape (n_p,)
        Of the slopes, where the proof uses them because there are too many corners; empty otherwise.
    channels : tuple of str
        Slopes that move.
    margin : float or None
        One minus the largest squared singular value over all corners in the coordinates where P is the identity.
    method : str
        By which method.
    solve_s : float

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, relift_certificate
    >>> lifting = Lifting(("x",), ("sin(x)",))
    >>> plant = Observer.open_loop("x", lifting, np.array([[0.5, 0.2], [0, 0]]), np.ones((2, 1)), (0,), ("u",), 1.0)
    >>> certificate = relift_certificate(plant)
    >>> certificate.certified, certificate.status.value, certificate.lower_bound <= certificate.gain
    (True, 'certified', True)
    """

    scales: ReliftScales
    assumptions: tuple[str, ...]
    box: Box
    parameters: Box
    status: ReliftStatus = ReliftStatus.UNBOUNDED
    reason: str = ""
    certified: bool = False
    gain: float | None = None
    mismatch_gain: float | None = None
    lower_bound: float | None = None
    start: Array = field(default_factory=lambda: np.zeros((0, 0)))
    roots: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    corners: Array = field(default_factory=lambda: np.zeros((0, 0)))
    multipliers: Array = field(default_factory=lambda: np.zeros(0))
    channels: tuple[str, ...] = ()
    margin: float | None = None
    method: str = ""
    solve_s: float = 0.0

    def system(self, observer: ObserverData) -> ErrorSystem:
        """Return the error dynamics that the certificate is about."""
        return error_system(observer, self.scales, self.box, self.parameters)

    def initial_energy(self, error: npt.ArrayLike) -> Array:
        """Return V(e_0) in scaled units, shape (...): the price of starting with an error, shape (..., n_window), the controller at rest.

        The first error is in physical units; behind it are earlier errors where the lifting has delays.
        """
        xi = np.asarray(error, dtype=float) @ self.start[:, : np.shape(error)[-1]].T
        energies = [np.sum((xi @ R.T) ** 2, axis=-1) for R in self.roots]
        return np.asarray(np.max(energies, axis=0))

    def in_sizes(self, observer: ObserverData, sizes: Mapping[str, float]) -> ReliftCertificate:
        """Return what the certificate of an observer says of the same observer for signals divided by other sizes (`kros.observer.in_sizes`)."""
        x, u = factors(observer, sizes)
        n, lifting = observer.lifting.n_states, observer.lifting
        by_name = dict(
            zip((*lifting.states, *observer.inputs), np.concatenate([x[:n], u[: len(observer.inputs)]]), strict=True)
        )
        errors = [by_name[name] for name, _ in lifting.window.quantities if name in lifting.states]
        y = x[list(observer.measured)]
        scales = ReliftScales(self.scales.error * x[:n], self.scales.residual * x[:n], self.scales.noise * y)
        box = {name: tuple(np.multiply(value, by_name.get(name, 1.0)).tolist()) for name, value in self.box.items()}
        assumptions = _assumptions(observer, box, self.parameters)
        roots = self.roots.copy()
        if roots.size:
            roots /= state_sizes(observer, self.scales, np.array(errors))
        return replace(self, scales=scales, box=box, assumptions=assumptions, roots=roots)

    def save(self, folder: Path) -> None:
        """Write ``relift.json`` and ``arrays.npz``."""
        content = {name: getattr(self, name) for name in _PLAIN}
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {f"scales/{name}": getattr(self.scales, name) for name in ReliftScales.__dataclass_fields__}
        save_artifact(Path(folder), "relift", content, arrays)

    @classmethod
    @loader
    def load(cls, folder: Path) -> ReliftCertificate:
        """Read what `save` wrote."""
        content, arrays = load_artifact(Path(folder), "relift")
        values: dict[str, Any] = {name: content[name] for name in _PLAIN}
        values |= {"status": ReliftStatus(content["status"])} | {
            name: tuple(content[name]) for name in ("channels", "assumptions")
        }
        scales = ReliftScales(**{name: arrays[f"scales/{name}"] for name in ReliftScales.__dataclass_fields__})
        values |= {name: arrays[name] for name in _ARRAYS}
        return cls(scales=scales, **values)

    def __repr__(self) -> str:
        """Say what is proven, in a line."""
        said = (
            f"gain {self.gain:.4g} (at least {self.lower_bound:.4g})"
            if self.certified
            else f"{self.status.value}: {self.reason}"
        )
        return f"<ReliftCertificate {said}>"


_ARRAYS = ("start", "roots", "corners", "multipliers")
_PLAIN = tuple(name for name in ReliftCertificate.__dataclass_fields__ if name not in (*_ARRAYS, "scales"))


def relift_certificate(
    observer: ObserverData,
    box: Box | None = None,
    scales: ReliftScales | None = None,
    parameters: Box | None = None,
    *,
    mismatch: bool = True,
) -> ReliftCertificate:
    """Certify an observer as it runs: any lifting with bounded slopes, any correction filter or none, either way of injection.

    Parameters
    ----------
    observer : ObserverData
        With the delay and limits that its `runtime` declares.
    box : mapping of str to (lower, upper), optional
        Ranges of states (and of inputs, for input functions) inside which true and estimated values stay; needed where slopes have no global bound.
    scales : ReliftScales, optional
        Sizes of errors, residuals and noise; one by default, which leaves physical units.
    parameters : mapping of str to number or (lower, upper), optional
        Ranges of the lifting's parameters; any value by default, so that the certificate holds for every unit.
    mismatch : bool
        Whether to certify the distance from the frozen response as well.

    Returns
    -------
    ReliftCertificate
        Also where nothing could be proven: `certified` is false, and `status` and `reason` say why.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, relift_certificate
    >>> lifting = Lifting(("x",), ("sin(x)",))  # x+ = 0.5 x + 0.2 sin(x) + u: the error shrinks at least by 0.7 a step
    >>> plant = Observer.open_loop("x", lifting, np.array([[0.5, 0.2], [0, 0]]), np.ones((2, 1)), (0,), ("u",), 1.0)
    >>> round(relift_certificate(plant).gain, 1)
    3.3
    """
    start = time.perf_counter()
    asked = ReliftCertificate(
        scales or ReliftScales.ones(observer),
        _assumptions(observer, box, parameters),
        dict(box or {}),
        dict(parameters or {}),
    )
    try:
        system = asked.system(observer)
    except UnboundedSlopeError as error:
        return replace(
            asked,
            status=ReliftStatus.UNBOUNDED,
            reason=f"No certificate: {error}.",
            solve_s=time.perf_counter() - start,
        )
    few, width = system.corner_count <= MOST_CORNERS, system.L.shape[1]
    corners = np.array(list(product((-1.0, 1.0), repeat=width))) if few else np.zeros((0, width))
    found, reason, status = prove(system)
    first = np.zeros((0, 0)) if system.start is None else system.start
    tried = replace(asked, corners=corners, channels=system.channels, status=status, reason=reason, start=first)
    if found is None:
        return replace(tried, solve_s=time.perf_counter() - start)
    proposal, margin = found
    kappa = mismatch_gain(system) if mismatch else None
    return replace(
        tried,
        certified=True,
        gain=proposal.gain,
        mismatch_gain=kappa,
        lower_bound=frozen_gain(system),
        roots=proposal.root[None],
        multipliers=np.zeros(0) if few or proposal.multipliers is None else proposal.multipliers,
        margin=margin,
        method=proposal.how,
        solve_s=time.perf_counter() - start,
    )


def _assumptions(observer: ObserverData, box: Box | None, parameters: Box | None) -> tuple[str, ...]:
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
    if limits.delay:
        found.append(f"measurements arrive {limits.delay} samples late")
    if clips := limits.limited_states(len(names)):
        found.append(f"the true {', '.join(names[i] for i in clips)} stays within the limits of the estimate")
    if any(side is not None and np.isfinite(side).any() for side in (limits.input_lower, limits.input_upper)):
        found.append("the residual is that of the model with inputs within their limits")
    if observer.seen is not None:
        found.append("no measurement and no input is refused as implausible")
    return tuple(found)


def _ranges(box: Box) -> str:
    texts = []
    for name, value in box.items():
        low, high = value if np.ndim(value) else (value, value)
        texts.append(f"{name} in [{float(low):g}, {float(high):g}]")
    return ", ".join(texts)
