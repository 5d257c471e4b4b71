r"""Somebody who tries to break a certificate: sequences of residuals, noise and slopes that make the error as large as they can.

Nothing here knows how the certificate was made. On the error system (`attack`) a batch of sequences climbs in turns: for given slopes the
worst disturbance of unit energy by power iteration with the adjoint system (each step forward in time and backward),

    lambda_k = A_k' lambda_{k+1} + C'C xi_k,      w_k <- B_k' lambda_{k+1},      d_kj <- sign(lambda_{k+1}' L_j q_kj),

and for given disturbances the slopes go to the corners that the same adjoint points to. Sequences start from slopes at rest, at random, or greedy for
the Lyapunov function, and from sinusoids at the frequency where frozen slopes are worst. Against the observer as it runs (`attack_running`) the same
disturbances, at many amplitudes, drive a machine that is the observer's own model, so that everything is simulated by the code that is deployed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from kros.observer import Observer
from kros.observer.certificate.certificate import ReliftCertificate
from kros.observer.certificate.error import ErrorSystem
from kros.observer.certificate.proof import frozen_gain
from kros.observer.certificate.signals import first_error
from kros.observer.simulate import run_observer

Array = npt.NDArray[np.float64]
_BATCH = 16
_SHORTEST, _LONGEST = 300, 3000
_TIME_CONSTANTS = 3.0
_TINY = np.finfo(float).tiny
_FAR = 1e6  # times the size of errors: beyond it rounding of a state is no longer small beside the error


@dataclass(frozen=True, eq=False)
class Attack:
    """The worst that was found: gain from rest, share of what the certificate allows, steps, and the sequences."""

    gain: float
    share: float
    steps: int
    disturbance: Array
    slopes: Array


def attack(certificate: ReliftCertificate, observer: Observer, *, steps: int = 100_000, seed: int = 0) -> Attack:
    """Search for disturbances and slopes that exceed a certificate; no measurement is dropped."""
    assert certificate.gain is not None, certificate.reason
    system = certificate.system(observer)
    rng = np.random.default_rng(seed)
    radius = float(np.abs(np.linalg.eigvals(system.A)).max(initial=0.0))
    horizon = int(np.clip(_TIME_CONSTANTS / max(1 - radius, 1e-9), _SHORTEST, _LONGEST))
    search = _Search(system, certificate, rng, horizon)
    rounds = max(3, -(-steps // (_BATCH * horizon)))
    for _ in range(rounds):
        search.climb()
    ratios, frozen = search.ratios(), frozen_gain(system)
    best = int(np.argmax(np.where(search.at_rest, ratios, 0.0)))
    gain, share = max(float(ratios[best]), frozen), max(float(ratios.max()), frozen) / certificate.gain
    return Attack(gain, share, search.steps, search.w[:, best], search.d[:, best])


class _Search:
    """A batch of sequences; the second half starts with an error instead of at rest."""

    def __init__(
        self, system: ErrorSystem, certificate: ReliftCertificate, rng: np.random.Generator, horizon: int
    ) -> None:
        assert certificate.gain is not None
        self.system, self.rng, self.gain, self.steps = system, rng, certificate.gain, 0
        self.R = certificate.root
        self.inverse = np.linalg.inv(self.R)
        n_w, n_p = system.B.shape[1], system.L.shape[1]
        self.d = rng.choice([-1.0, 1.0], (horizon, _BATCH, n_p))
        self.d[:, 0], self.d[:, 1], self.d[:, 2] = 0.0, -1.0, 1.0
        self.w = rng.standard_normal((horizon, _BATCH, n_w))
        self._sinusoids()
        self.first = np.zeros((_BATCH, len(system.A)))
        self.first[_BATCH // 2 :] = rng.standard_normal((_BATCH // 2, len(system.A)))
        self._normalise()
        self._greedy(slice(4, 8))
        self.xi = self._run()

    @property
    def at_rest(self) -> npt.NDArray[np.bool_]:
        """Which sequences start without an error."""
        return ~np.any(self.first, axis=1)

    def climb(self) -> None:
        """One round: worst disturbance for the slopes, then slopes for the disturbance where that helps."""
        before = self.ratios()
        adjoint = self._adjoint()
        old_w, old_first = self.w.copy(), self.first.copy()
        self.w = np.einsum("kbi,ij->kbj", adjoint[1:], self.system.B) + np.einsum(
            "kbp,pj->kbj", self._push(adjoint), self.system.D
        )
        self.first = np.where(np.any(self.first, axis=1)[:, None], self.gain * adjoint[0] @ self.inverse, 0.0)
        self._normalise()
        self.xi = self._run()
        self._keep(before, w=old_w, first=old_first)
        if self.d.shape[2]:
            before = self.ratios()
            adjoint, old = self._adjoint(), self.d.copy()
            moved = np.sign((adjoint[1:] @ self.system.L) * self._moves())
            flips = self.rng.random(moved.shape) < self.rng.choice([0.1, 0.5, 1.0], (1, _BATCH, 1))
            self.d = np.where(flips & (moved != 0), moved, self.d)
            self.xi = self._run()
            self._keep(before, d=old)

    def _keep(self, before: Array, **old: Array) -> None:
        """Go back to the earlier values where the ratio fell."""
        after = self.ratios()
        worse = after < before
        if not worse.any():
            return
        for name, values in old.items():
            current = getattr(self, name)
            setattr(self, name, np.where(worse[:, None], values, current))
        self.xi = self._run()

    def _moves(self) -> Array:
        return np.asarray(self.xi[:-1] @ self.system.M.T + self.w @ self.system.D.T)

    def _push(self, adjoint: Array) -> Array:
        return np.asarray((adjoint[1:] @ self.system.L) * self.d)

    def _run(self) -> Array:
        """Simulate the batch; shape (n_samples + 1, batch, n_xi)."""
        s = self.system
        xi = np.zeros((len(self.w) + 1, _BATCH, len(s.A)))
        xi[0] = self.first @ self.inverse.T * self.gain  # V(first) = gain^2 |first|^2
        drive, A, L, M = self.w @ s.B.T, s.A.T.copy(), s.L.T.copy(), s.M.T.copy()
        direct = self.w @ s.D.T
        for k in range(len(self.w)):
            xi[k + 1] = xi[k] @ A + drive[k] + ((xi[k] @ M + direct[k]) * self.d[k]) @ L
        self.steps += len(self.w) * _BATCH
        return xi

    def _adjoint(self) -> Array:
        s = self.system
        costate = np.zeros_like(self.xi)
        source = self.xi @ (s.C.T @ s.C)
        costate[-1] = source[-1]
        for k in range(len(self.w) - 1, -1, -1):
            costate[k] = costate[k + 1] @ s.A + ((costate[k + 1] @ s.L) * self.d[k]) @ s.M + source[k]
        return costate

    def ratios(self) -> Array:
        """Energy of the error over that of the disturbance and of the initial error in units of gamma, square roots; shape (batch,)."""
        out = np.sum((self.xi @ self.system.C.T) ** 2, axis=(0, 2))
        return np.asarray(np.sqrt(out / (np.sum(self.w**2, axis=(0, 2)) + np.sum(self.first**2, axis=1) + _TINY)))

    def _normalise(self) -> None:
        size = np.sqrt(np.sum(self.w**2, axis=(0, 2)) + np.sum(self.first**2, axis=1) + _TINY)
        self.w, self.first = self.w / size[:, None], self.first / size[:, None]

    def _sinusoids(self) -> None:
        """Give a few sequences the frequency and direction where frozen slopes are worst."""
        s, n = self.system, len(self.w)
        freqs = np.concatenate([[0.0], np.geomspace(0.5 / n, 0.5, 200)]) / s.dt
        for member in range(min(4, _BATCH)):
            response = s.frozen(self.d[0, member]).frequency_response(freqs)
            f = int(np.argmax(np.linalg.norm(response, 2, axis=(1, 2))))
            direction = np.linalg.svd(response[f])[2][0].conj()
            phase = 2 * np.pi * freqs[f] * s.dt * np.arange(n)
            self.w[:, member] = (np.exp(1j * phase)[:, None] * direction).real

    def _greedy(self, members: slice) -> None:
        """Choose slopes that make the Lyapunov function largest at the next step."""
        s = self.system
        P = self.R.T @ self.R
        xi = self.first[members] @ self.inverse.T * self.gain
        for k in range(len(self.w)):
            w = self.w[k, members]
            q, free = xi @ s.M.T + w @ s.D.T, xi @ s.A.T + w @ s.B.T
            d = np.where((free @ P @ s.L) * q >= 0, 1.0, -1.0)
            self.d[k, members] = d
            xi = free + (d * q) @ s.L.T


def attack_running(
    certificate: ReliftCertificate,
    observer: Observer,
    disturbance: Array,
    start: Array,
    inputs: Array,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    *,
    amplitudes: tuple[float, float] = (1e-3, 1e3),
    seed: int = 0,
) -> tuple[float, int]:
    """Drive a machine that is the observer's model; return the largest share of what the certificate allows, and the steps.

    `disturbance` is as `attack` leaves it, `start` is (batch, n), `inputs` (at least n_samples + 1, batch, m); amplitudes are RMS.
    """
    assert certificate.gain is not None, certificate.reason
    observer = replace(observer, seen=None)  # the disturbances are to arrive
    rng, lifting, scales = np.random.default_rng(seed), observer.lifting, certificate.scales
    n, steps, batch = lifting.n_states, len(disturbance), len(start)
    values = {**observer.parameters, **(parameters or {})} if lifting.parameters else None
    level = np.exp(rng.uniform(np.log(amplitudes[0]), np.log(amplitudes[1]), batch)) / np.sqrt(
        np.mean(np.sum(disturbance**2, axis=1)) + _TINY
    )
    w = disturbance[:, None] * (level * rng.choice([-1.0, 1.0], batch))[:, None]
    omega, noise = w[..., :n] * scales.residual, w[..., n:] * scales.noise
    x = np.zeros((steps + 1, batch, n))
    x[0] = start
    earlier = lifting.window.hold(x[0], inputs[0])
    for k in range(steps):
        window = np.concatenate([x[k], earlier], axis=-1)
        x[k + 1] = (
            lifting.lift(window, values) @ observer.A[:n].T
            + lifting.lift_inputs(inputs[k], window, values) @ observer.B[:n].T
            + omega[k]
        )
        earlier = lifting.window.advance(window, inputs[k])
    late = observer.runtime.delay
    y = x[np.maximum(np.arange(steps + 1) - late, 0)][..., list(observer.measured)]
    y[late:-1] += noise[late:]
    estimates = run_observer(observer, y, inputs[: steps + 1], values)
    first = first_error(observer, x[0] - estimates[0])
    # A machine may be unstable, its observer is not: what counts is the time until rounding of the machine's state is seen. The bound is causal.
    # So does the time until the true state leaves declared limits, which the certificate excludes.
    low, high = observer.runtime.sides(x.shape[2])
    inside = ((x >= low) & (x <= high)).all(axis=2)
    seen = np.logical_and.accumulate((np.abs(x / scales.error).max(axis=2) < _FAR) & inside, axis=0)
    spent = np.cumsum(np.sum(w**2, axis=2), axis=0)[np.maximum(seen.sum(axis=0) - 2, 0), np.arange(batch)]
    allowed = certificate.gain**2 * spent + np.sum(
        (first @ certificate.start[:, : first.shape[-1]].T @ certificate.root.T) ** 2, axis=-1
    )
    energy = np.sum(((x - estimates) / scales.error) ** 2, axis=(0, 2), where=seen[..., None])
    return float(np.sqrt(np.max(energy / (allowed + _TINY)))), int(seen[1:].sum())
