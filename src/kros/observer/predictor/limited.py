r"""Predictors of machines whose hidden states meet limits: estimates within them, and internal states that do not wind up.

A predictor knows the machine within its limits. Where the command meets one, what it has seen keeps pushing the estimate beyond, and its internal
states follow. Here the estimate as it would be without limits becomes an internal state r of its own, and what all others read of the limited
state is turned by a gain:

.. math:: r^+ = f(\hat x, m, r, u) + \Gamma_r c, \quad \hat x_l^+ = \operatorname{clip}(r^+), \quad m^+ = \dots + \Gamma_m c, \qquad c = \hat x_l - r .

Within the limits c is zero and nothing changes. The gain is an ordinary column of A, the limit an entry of `Runtime`: the observer that runs,
in a batch or sample by sample, is one like any other, re-lifted from the clipped estimate. With the gain zero the internal states run on as if there
were no limits, and the estimate alone is cut off: no worse than before. From there Gauss-Newton steps with the limits in the loop, on recordings that
meet them, lead to a gain for which r comes back as the machine does (back-calculation, the conditioning of controllers, learned).

References
----------
K. J. Astrom and L. Rundqwist, "Integrator windup and how to avoid it", American Control Conference 1989, 1693-1698.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...core.linalg import least_squares
from ...core.lti import gain
from ...data import EpisodeBatch
from ..certificate.error import ErrorSystem, UnboundedSlopeError, error_system
from ..certificate.riccati import frequency_bound
from ..observer import Observer
from ..runtime import Runtime
from ..simulate import run_observer
from ..tuning.gauss_newton import Damping, mean_log, scaled, search

Array = npt.NDArray[np.float64]
_DAMPING = Damping(1e-7, 1e-2, 1e6, 6.0)
_THIN = 4
_FREQUENCIES = 400
_MARGIN, _SHORT, _BARRIER = (
    0.25,
    0.9,
    1e-3,
)  # of the circle criterion without a gain, of the way to it, and weight of its logarithm
_TINY = 1e-6
_ABOUT = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0)  # widths of a resonance
_COUPLED, _ROUNDS = (
    0.3,
    60,
)  # share of the room that slopes may take in the beginning, and of the search for their multipliers


def with_limits(observer: Observer, lower: npt.ArrayLike, upper: npt.ArrayLike) -> Observer:
    """Return a predictor with limits of its recorded states, shape (n_recorded,), infinite where there is none; its internal states run on.

    Every hidden state with a limit gets an internal state more, behind the others: its estimate without the limit, which all rows read.
    """
    n, recorded = observer.lifting.n_states, len(observer.recorded)
    sides = [np.asarray(side, dtype=float) for side in (lower, upper)]
    at = [i for i in range(recorded) if i not in observer.measured and any(np.isfinite(side[i]) for side in sides)]
    place = [
        *range(n),
        *at,
        *range(n, observer.lifting.n_lifted),
    ]  # of the widened states: every raw one begins as a copy
    A, B, D = observer.A[np.ix_(place, place)], observer.B[place], observer.controller.D[place]
    A[:, at] = 0.0
    lifting = replace(
        observer.lifting, states=(*observer.lifting.states, *(f"memory_{n - recorded + i + 1}" for i in range(len(at))))
    )
    none = np.full(len(lifting.states) - recorded, np.inf)
    runtime = replace(observer.runtime, lower=np.append(sides[0], -none), upper=np.append(sides[1], none), relift=True)
    controller = gain(D, observer.sample_period_s)
    return replace(
        observer,
        lifting=lifting,
        A=A,
        B=B,
        controller=controller,
        internal=observer.internal + len(at),
        runtime=runtime,
    )


def limited_states(observer: Observer) -> list[int]:
    """Return the hidden states with limits of a predictor of `with_limits`; as many internal states at the end are these without them."""
    n, recorded = observer.lifting.n_states, len(observer.recorded)
    at = [i for i in observer.runtime.clipped_states(n) if i < recorded and i not in observer.measured]
    return at if len(at) <= observer.internal and np.array_equal(observer.A[at], observer.A[n - len(at) : n]) else []


def conditioned(
    observer: Observer, batch: EpisodeBatch, importance: npt.ArrayLike = 1.0, iterations: int = 40
) -> Observer:
    """Return a predictor of `with_limits` with the gain that is best on recordings that meet the limits."""
    problem = _Conditioning(observer, batch, importance)
    start = problem.at(np.zeros((len(problem.F), len(problem.raw))), problem.stability.first)
    found, _ = search(start, problem.steps, _DAMPING, iterations, 1e-3, patience=2)
    turned = _turned(observer, problem.rows, found.gain)
    return _turned(turned, list(observer.measured), _of_measured(turned, batch))


def _turned(observer: Observer, rows: list[int], gain: Array) -> Observer:
    """The observer with a gain, shape (rows, limited), from what limits cut off."""
    A, at, n = observer.A.copy(), limited_states(observer), observer.lifting.n_states
    raw = list(range(n - len(at), n))
    A[np.ix_(rows, at)] += gain
    A[np.ix_(rows, raw)] -= gain
    A[at] = A[raw]
    return replace(observer, A=A)


def _slopes_of(observer: Observer) -> tuple[ErrorSystem, Array]:
    """The errors' dynamics without limits and delay, with slopes of lifted functions and multipliers that prove it stable."""
    alone, n = replace(observer, runtime=Runtime()), observer.lifting.n_states
    try:
        system = error_system(alone)
        multipliers, least = frequency_bound(system)
        if np.isfinite(least):
            return system, multipliers
    except UnboundedSlopeError:
        pass
    A = observer.A.copy()
    A[:, n:] = 0.0
    return error_system(replace(alone, A=A)), np.ones(0)


def _of_measured(observer: Observer, batch: EpisodeBatch) -> Array:
    """The gain of the measured states' rows, shape (q, limited), by least squares: nothing comes back from them."""
    at, n, y = limited_states(observer), observer.lifting.n_states, batch.measurements(observer.measured, arrived=False)
    estimates = run_observer(observer, y, batch.inputs, observer.own(batch.parameters))
    excess = (estimates[..., at] - estimates[..., n - len(at) :])[:-1].reshape(-1, len(at))
    missed = (y - estimates[..., list(observer.measured)])[1:].reshape(len(excess), -1)
    return least_squares(excess, missed).T


@dataclass(frozen=True, eq=False)
class _Point:
    """A gain, the multipliers that its criterion of stability has, what the estimates miss and how they move with it, and the criterion."""

    gain: Array
    multipliers: Array
    missed: Array
    slopes: Array
    criterion: float


class _Conditioning:
    """Recordings that meet the limits; `rows` are the states beside the measured and the limited ones, whose rows the gain enters."""

    def __init__(self, observer: Observer, batch: EpisodeBatch, importance: npt.ArrayLike) -> None:
        n, at = observer.lifting.n_states, limited_states(observer)
        assert observer.runtime.lower is not None
        assert observer.runtime.upper is not None
        self.lower, self.upper = observer.runtime.lower[at], observer.runtime.upper[at]
        self.raw_states = list(range(n - len(at), n))
        self.rows = [i for i in range(n) if i not in observer.measured and i not in at]
        self.raw = [self.rows.index(i) for i in self.raw_states]
        hidden = [i for i in range(len(observer.recorded)) if i not in observer.measured]
        self.shown = [self.raw[at.index(i)] if i in at else self.rows.index(i) for i in hidden]
        self.limits = [at.index(i) if i in at else -1 for i in hidden]
        values = observer.own(batch.parameters)
        x = np.zeros((*batch.states.shape[:2], n))
        y = batch.measurements(observer.measured, arrived=False)
        x[..., list(observer.measured)] = y
        self.F = observer.A[np.ix_(self.rows, self.rows)]
        self.drive = observer.lifting.lift(x, values) @ observer.A[self.rows].T + batch.inputs @ observer.B[self.rows].T
        self.start = observer.initial(y[0], values)[:, self.rows]
        self.truth = batch.states[..., hidden]
        share = np.broadcast_to(np.asarray(importance, dtype=float), len(hidden))
        self.share = np.tile(share / share.sum() / len(batch.keys), (len(batch.keys), 1))
        self.stability = _Stability(observer, self.rows, self.raw_states)

    def at(self, gain: Array, multipliers: Array) -> _Point:
        """Run the predictor with a gain."""
        with np.errstate(over="ignore", invalid="ignore"):
            estimates, slopes = self._run(gain)
            missed = self.truth - estimates
            criterion = mean_log(self.share.ravel(), np.mean(missed**2, axis=0).ravel())
        return _Point(
            gain, multipliers, missed, slopes, criterion + _BARRIER * self.stability.barrier(gain, multipliers)
        )

    def steps(self, point: _Point) -> Callable[[float], _Point]:
        """Gauss-Newton steps, those of the barrier included."""
        size, multipliers = point.gain.size, self.stability.best(point.gain, point.multipliers)
        root = np.sqrt(self.share / np.mean(point.missed**2, axis=0))
        X = (point.slopes * root[:, None]).transpose(2, 0, 1, 3).reshape(size, -1)
        missed = (point.missed[::_THIN] * root).ravel()
        white = np.linalg.inv(np.linalg.cholesky(self.stability.distance(point.gain, multipliers)))
        moved = self.stability.moved(np.eye(size).reshape(size, *point.gain.shape), multipliers)
        moved = white @ moved @ white.conj().swapaxes(-1, -2)
        traces = np.trace(moved, axis1=2, axis2=3).real.mean(axis=1)
        moved = moved.reshape(size, -1)
        rows, frequencies = len(point.missed[::_THIN]), len(white)
        H, g, sizes = scaled(
            X @ X.T / rows + _BARRIER * (moved @ moved.conj().T).real / frequencies,
            X @ missed / rows + _BARRIER * traces,
        )

        def trial(damping: float) -> _Point:
            step = (np.linalg.solve(H + damping * np.eye(size), g) / sizes).reshape(point.gain.shape)
            towards = white @ self.stability.moved(step[None], multipliers)[0] @ white.conj().swapaxes(-1, -2)
            least = float(np.linalg.eigvalsh(towards).min())
            return self.at(point.gain + (1.0 if least >= 0 else min(1.0, -_SHORT / least)) * step, multipliers)

        return trial

    def _run(self, gain: Array) -> tuple[Array, Array]:
        """Return estimates of the hidden states, shape (n_samples, batch, h), and their slopes by the gain, (n_samples / thin, batch, gain.size, h)."""
        n_samples, batch = self.drive.shape[:2]
        F, raw, limits = self.F.T, self.raw, np.array(self.limits)
        h, moved = self.start.copy(), np.zeros((batch, gain.size, len(self.F)))
        estimates, slopes = (
            np.empty(self.truth.shape),
            np.empty((-(-n_samples // _THIN), batch, gain.size, len(self.shown))),
        )
        by_gain = np.eye(gain.size).reshape(gain.size, *gain.shape)  # (parameter, row, limit)
        for k in range(n_samples):
            excess = np.clip(h[:, raw], self.lower, self.upper) - h[:, raw]
            met = excess != 0.0
            estimates[k] = h[:, self.shown]
            estimates[k][:, limits >= 0] += excess[:, limits[limits >= 0]]
            if k % _THIN == 0:
                slopes[k // _THIN] = moved[..., self.shown]
                slopes[k // _THIN][..., limits >= 0] *= ~met[:, None, limits[limits >= 0]]
            following, turned = h @ F + self.drive[k], moved @ F
            at = np.flatnonzero(met.any(axis=1))
            if len(at):
                following[at] += excess[at] @ gain.T
                turned[at] += np.einsum("bl,pnl->bpn", excess[at], by_gain)
                turned[at] -= np.where(met[at][:, None], moved[at][..., raw], 0.0) @ gain.T
            h, moved = following, turned
        return estimates, slopes


class _Stability:
    r"""How far a gain is from where limits that come and go at will, and slopes of lifted functions anywhere in their box, might let errors grow.

    What limits cut off, ``c = -(1 - d) e_r`` with d in [0, 1], obeys ``c*(-e_r - c) >= 0``, and what the slopes add ``|q|^2 >= |p|^2`` (p half of
    their boxes times errors). With multipliers t of the slopes and responses G from (c, p) to (e_r, q) the errors are stable where

    .. math:: \begin{bmatrix} I + \tfrac12 (G_{rc} + G_{rc}^*) & \cdot & \cdot \\ (2t)^{-1/2} G_{rp}^* & I & \cdot \\
              (t/2)^{1/2} G_{qc} & t^{1/2} G_{qp} t^{-1/2} & I \end{bmatrix} \succ 0

    at all frequencies: the circle criterion, which is linear in the gain for given multipliers.
    """

    def __init__(self, observer: Observer, rows: list[int], raw: list[int]) -> None:
        system, t = _slopes_of(observer)
        out, into = (
            np.vstack([np.eye(len(system.A))[raw], system.M]),
            np.hstack([np.eye(len(system.A))[:, rows], system.L]),
        )
        poles = np.linalg.eigvals(system.A)
        width, angle = 1 - np.abs(poles), np.abs(np.angle(poles))
        near = (angle + np.multiply.outer(_ABOUT, width)).ravel()
        grid = np.concatenate([[0.0], np.geomspace(1e-5, np.pi, _FREQUENCIES), near[(near > 0) & (near < np.pi)]])
        resolvents = np.linalg.inv(np.exp(1j * grid)[:, None, None] * np.eye(len(system.A)) - system.A)
        responses = out @ resolvents @ into
        self.limits, self.slopes = len(raw), len(system.M)
        self.by_gain, self.by_slopes = responses[..., : len(rows)], responses[..., len(rows) :]
        self.margin = 0.0
        none = np.zeros((len(rows), self.limits))
        if self.slopes:
            coupled = np.abs(self.by_slopes[:, : self.limits] / np.sqrt(2 * t)).max()
            t = t * max(coupled / _COUPLED, _TINY) ** 2
            steps = (t * 4.0**k for k in range(_ROUNDS // 2))
            found = next((larger for larger in steps if np.isfinite(self.barrier(none, larger))), None)
            if (
                found is None
            ):  # between the frequencies that were looked at slopes let errors grow: the limits alone are left
                self.slopes, self.by_gain, self.by_slopes = (
                    0,
                    self.by_gain[:, : self.limits],
                    self.by_slopes[:, : self.limits, :0],
                )
            t = np.ones(0) if found is None else found
        self.first = t
        self.margin = _MARGIN * float(np.linalg.eigvalsh(self.distance(none, self.first))[:, 0].min())

    def distance(self, gain: Array, t: Array) -> Array:
        """Return the matrices above, less a margin, shape (frequency, w, w)."""
        found = self.moved(gain[None], t)[0]
        at, limits = self.limits, self.limits + self.slopes
        found[:, :at, at:limits] += self.by_slopes[:, :at] / np.sqrt(2 * t)
        found[:, limits:, at:limits] += np.sqrt(t)[:, None] * self.by_slopes[:, at:] / np.sqrt(t)
        found[:, at:limits, :at] = found[:, :at, at:limits].conj().swapaxes(-1, -2)
        found[:, at:limits, limits:] = found[:, limits:, at:limits].conj().swapaxes(-1, -2)
        return np.asarray(found + (1 - self.margin) * np.eye(found.shape[-1]))

    def moved(self, gains: Array, t: Array) -> Array:
        """Return what gains, shape (g, rows, limits), add to them, shape (g, frequency, w, w)."""
        responses, at = self.by_gain @ gains[:, None], self.limits
        found = np.zeros((*responses.shape[:2], *(2 * [at + 2 * self.slopes])), dtype=complex)
        found[..., :at, :at] = (responses[..., :at, :] + responses[..., :at, :].conj().swapaxes(-1, -2)) / 2
        found[..., at + self.slopes :, :at] = np.sqrt(t / 2)[:, None] * responses[..., at:, :]
        found[..., :at, at + self.slopes :] = found[..., at + self.slopes :, :at].conj().swapaxes(-1, -2)
        return found

    def barrier(self, gain: Array, t: Array) -> float:
        """Return the mean over frequencies of the logarithm that grows beyond all bounds at the edge; infinite beyond it."""
        try:
            root = np.linalg.cholesky(self.distance(gain, t))
        except np.linalg.LinAlgError:
            return np.inf
        return float(-2 * np.mean(np.sum(np.log(np.diagonal(root, axis1=1, axis2=2).real), axis=1)))

    def best(self, gain: Array, t: Array) -> Array:
        """Return the multipliers in the middle of those that a gain allows, from some of them."""
        from scipy.optimize import minimize

        if not self.slopes or not gain.any():
            return t
        found = minimize(
            lambda log: self.barrier(gain, t * np.exp(log)),
            np.zeros(len(t)),
            method="Nelder-Mead",
            options={"maxiter": _ROUNDS},
        )
        return np.asarray(t * np.exp(found.x))
