r"""A bound on the error for a set of signals: residuals of recorded motion, by their energies in bands.

Let ``w_k``, k from -1, be the first error followed by the one-step residual and the noise of a recording, and T_j the
frozen response from w to the error of state j as the observer runs, delay included. Then (`relift` page)

.. math:: \|e_j\| \le \Big(\sum_b \mathrm{tr}(M_{jb} \Phi_b)\Big)^{1/2}
          + \kappa_j \Big(\sum_l \frac{1}{s_l^2} \sum_b \mathrm{tr}(M_{lb} \Phi_b)\Big)^{1/2},

``M_b`` above ``T^H T`` throughout band b for the error and for what the slopes and limits act on (`majorants`), and
``kappa_j`` the proven gain from the latter, divided by sizes s, to what they can add to state j alone. It holds for
every signal with energies of at most ``Phi_b``: for those of a unit whatever course they take, for the cover of all
units whatever unit they come from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...data import EpisodeBatch
from ...uncertainty.band_energies import BandEnergies, band_edges, cover
from ..data import ObserverData
from .certificate import ReliftCertificate
from .course import Course, course
from .error import ErrorSystem, error_system
from .majorants import energy, majorants
from .search import proven_gain

Array = npt.NDArray[np.float64]
_BANDS, _BELOW = 96, 10  # bands, the lowest of which ends at a tenth of an episode's lowest frequency
_TOO_SHARP = "no bound: the responses of its error are too sharp to be enclosed by the arcs that are tried"
_RIDGE = 1e-6
_SPARE = 1e-6
_OTHERS = (0.0, 1e-3, 1.0)  # weights of other states' errors: with them the Riccati equation is better conditioned


@dataclass(frozen=True, eq=False)
class SignalBound:
    """Bounds on the errors of one observer at run time.

    Parameters
    ----------
    states : tuple of str
        Of the recordings.
    units : tuple of str
    cover : ndarray, shape (n,)
        Bound on the RMS error of every state for any signal inside the cover of all units; infinite where there is
        none.
    bounds : ndarray, shape (units, n)
        For any signal with the energies of one unit.
    errors : ndarray, shape (units, n)
        RMS errors as they were.
    sizes : ndarray, shape (n,)
        Ranges of the states; all of the above are in the states' own units of measure.
    reason : str
        Why there is no bound; empty where there is one.
    outside : tuple of str
        Units of which the observer refuses samples as implausible. Their rows are infinite.

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.observer import relift_certificate, signal_bound
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(motors, refine=False), n_freqs=50, max_order=1)
    >>> observer = kros.synthesize(uncertain, "kalman_tuned", methods=()).observer
    >>> bound = signal_bound(relift_certificate(observer), observer, EpisodeBatch.read(motors, motors.keys()))
    >>> bound.states, bound.bounds.shape, bool((bound.errors <= bound.bounds).all())
    (('position', 'velocity', 'current'), (2, 3), True)
    """

    states: tuple[str, ...]
    units: tuple[str, ...]
    cover: Array
    bounds: Array
    errors: Array
    sizes: Array
    reason: str = ""
    outside: tuple[str, ...] = ()

    @property
    def certified(self) -> bool:
        """Whether every state has a bound for all signals inside the cover."""
        return bool(np.isfinite(self.cover).all())

    @property
    def ratios(self) -> Array:
        """Bounds over errors, shape (units, n)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(self.errors > 0, self.bounds / self.errors, np.inf))

    def percent(self) -> dict[str, float | None]:
        """Return the bound of the cover by state, percent of the range; None where there is none."""
        values = 100 * self.cover / self.sizes
        return {name: float(v) if np.isfinite(v) else None for name, v in zip(self.states, values, strict=True)}

    def facts(self, measured: Sequence[int] = ()) -> dict[str, Any]:
        """Return what goes into the metrics; ratios are those of hidden states, of all where none is."""
        if not self.certified:
            return {"set_certified": False, "set_reason": self.reason}
        hidden = [j for j in range(len(self.states)) if j not in measured] or list(range(len(self.states)))
        ratios = self.ratios[:, hidden]
        ratios = ratios[np.isfinite(ratios)]
        facts: dict[str, Any] = {"set_certified": True, "set_bound_percent": self.percent()}
        least, most = (float(ratios.min()), float(ratios.max())) if ratios.size else (None, None)
        ratio = {"set_bound_to_error_min": least, "set_bound_to_error_max": most}
        return facts | ratio | {"set_outside": list(self.outside)}

    def in_sizes(self, factors: npt.ArrayLike) -> SignalBound:
        """Return the same for states in other units of measure, by their factors, shape (n,)."""
        by = np.asarray(factors, dtype=float)
        return replace(self, **{name: getattr(self, name) * by for name in ("cover", "bounds", "errors", "sizes")})


def signal_bound(
    certificate: ReliftCertificate,
    observer: ObserverData,
    batch: EpisodeBatch,
    estimates: Array | None = None,
    known: dict[bytes, BandEnergies] | None = None,
) -> SignalBound:
    """Bound the errors of an observer for signals like those of recorded episodes.

    Parameters
    ----------
    certificate : ReliftCertificate
        Of this observer: its box, parameters and sizes of errors are taken.
    observer : ObserverData
    batch : EpisodeBatch
        Training episodes; noise is what its sensor shows beside the recording, and no sample of it is lost.
    estimates : ndarray, shape (n_samples, batch, n), optional
        Of `run_observer` for these measurements; it is run where they are missing.
    known : dict, optional
        Energies that were found already, for observers of one model: filled here.

    Returns
    -------
    SignalBound
        Also where there is none: `reason` says why.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.core import gain
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, relift_certificate, signal_bound
    >>> from kros.synthesis import Injection
    >>> x = np.random.default_rng(0).normal(size=(2, 200, 2)).cumsum(axis=1)
    >>> names = {"states": ["x"], "measured": ["x"], "inputs": ["u"]}
    >>> population = kros.from_arrays({"a": [x[0]], "b": [x[1]]}, **names, sample_period_s=0.01)
    >>> batch = kros.data.EpisodeBatch.read(population, population.keys())
    >>> model = np.array([[0.9]]), np.ones((1, 1)), (0,), ("u",)
    >>> observer = Observer("x", Lifting(("x",)), *model, gain([[0.5]], 0.01), Injection.STATE, 0.01)
    >>> bound = signal_bound(relift_certificate(observer), observer, batch)
    >>> bool((bound.errors <= bound.bounds).all())
    True
    """
    seen = course(observer, batch, estimates)
    n, taken = len(observer.recorded), seen.taken(observer)
    units = tuple(dict.fromkeys(batch.units))
    member = np.array([[unit == name for unit in batch.units] for name in units], dtype=float)
    member /= member.sum(axis=1, keepdims=True)
    errors = np.sqrt(member @ seen.mean_square(seen.error[..., :n] + seen.beyond))
    none, sizes = np.full(n, np.inf), certificate.scales.error[:n].copy()
    result = SignalBound(observer.recorded, units, none, np.full(errors.shape, np.inf), errors, sizes)
    if not certificate.certified:
        return replace(result, reason="it has no certificate at run time")
    signal, system = _signals(certificate, observer, seen)
    if not system.moved().is_stable():
        return replace(result, reason="its error does not settle where slopes and limits rest")
    bounds = _bounds(system, n, _energies(signal, batch, known).of_units(batch.units))
    if bounds is None:
        return replace(result, reason=_TOO_SHARP)
    cover, each = bounds
    outside = tuple(unit for unit, rows in zip(units, member > 0, strict=True) if not taken[rows].all())
    each[[unit in outside for unit in units]] = np.inf
    reason = "" if np.isfinite(cover).all() else "what slopes and limits can add has no proven gain"
    by, beyond = sizes * (1 + _SPARE), np.sqrt(member @ seen.mean_square(seen.beyond))
    cover = cover * by + beyond.max(axis=0)
    return replace(result, cover=cover, bounds=each * by + beyond, reason=reason, outside=outside)


def _bounds(system: ErrorSystem, n: int, energies: BandEnergies) -> tuple[Array, Array] | None:
    """Return bounds of n scaled errors for the cover of all units, (n,), and for every unit, (units, n)."""
    frozen = system.moved()
    C, D = np.vstack([system.C[:n], frozen.C]), np.vstack([np.zeros((n, frozen.n_inputs)), frozen.D])
    plant = StateSpace(frozen.A, frozen.B, C, D, system.dt)
    # The cover is made for the errors and for what slopes act on: a matrix that no unit exceeds, where it matters.
    rough = majorants(plant, energies.edges, energies.energy.mean(axis=0))
    if rough is None:
        return None
    size = np.maximum(energy(rough, energies.energy).max(axis=0), np.finfo(float).tiny)
    matter = np.einsum("p,pbij->bij", 1 / size, rough)
    matter = matter + _RIDGE * np.einsum("bii->b", matter).real[:, None, None] * np.eye(matter.shape[-1])
    final = cover(energies.energy, matter)
    M = majorants(plant, energies.edges, final)
    if M is None:
        return None
    whole, each = np.sqrt(energy(M, final)), np.sqrt(energy(M, energies.energy))
    acted = np.maximum(whole[n:], np.finfo(float).tiny)
    kappa = mismatch_gains(system, acted, n)
    share = np.linalg.norm(each[:, n:] / acted, axis=1)[:, None]
    with np.errstate(invalid="ignore"):
        movement = [np.where(kappa > 0, kappa * part, 0.0) for part in (np.sqrt(len(acted)), share)]
    return whole[:n] + movement[0], each[:, :n] + movement[1]


def mismatch_gains(system: ErrorSystem, acted: Array, n: int) -> Array:
    """Return proven gains from what the channels act on, over sizes, to what they add to each of n errors."""
    if not len(acted):
        return np.zeros(n)
    if not np.isfinite(acted).all():
        return np.full(n, np.inf)
    rest = system.mismatch()
    top = float(acted.max())  # without it gains underflow where channels hardly act
    rest = replace(rest, B=rest.B * (acted / top), D=rest.D * (acted / top))
    found = np.full(n, np.inf)
    for j in range(n):
        for others in _OTHERS:
            weight = np.full((len(rest.C), 1), others)
            weight[j] = 1.0
            found[j] = proven_gain(replace(rest, C=weight * rest.C))
            if np.isfinite(found[j]):
                break
    return found * top


def _signals(certificate: ReliftCertificate, observer: ObserverData, seen: Course) -> tuple[Array, ErrorSystem]:
    """Return the signals, (n_samples, batch, m), of size one, and the system from them to the scaled errors."""
    n, q = len(observer.recorded), len(observer.measured)
    start = seen.first[None, :, :n]
    later = np.concatenate([seen.omega[..., :n], seen.noise], axis=-1)
    noisy = bool(seen.noise.any())
    before = np.concatenate([start, np.zeros((1, start.shape[1], q))], axis=-1)
    if observer.lifting.history:
        before = np.concatenate([np.zeros_like(before), start], axis=-1)
        later = np.concatenate([later, np.zeros((*later.shape[:2], n))], axis=-1)
    signal = np.concatenate([before, later])
    size = np.sqrt(np.mean(signal**2, axis=(0, 1)))
    size[size == 0] = 1.0
    internal = np.zeros(observer.lifting.n_states - n)
    scales = replace(certificate.scales, residual=np.concatenate([size[:n], internal]), noise=size[n : n + q])
    system = error_system(observer, scales, certificate.box, certificate.parameters)
    nw = observer.lifting.n_states
    columns = [*range(n), *(range(nw, nw + q) if noisy else ())]
    B, D = system.B[:, columns], system.D[:, columns]
    keep = [*range(n), *(range(n, n + q) if noisy else ())]
    if observer.lifting.history:
        assert system.start is not None
        earlier = [
            observer.lifting.states.index(name)
            for name, _ in observer.lifting.window.quantities
            if name in observer.lifting.states
        ]
        spread = np.eye(nw)[earlier][:, :n]  # the first error and the earlier ones that equal it
        B = np.hstack([B, system.start @ spread * size[n + q :]])
        D = np.hstack([D, np.zeros((len(D), n))])
        keep += range(n + q, 2 * n + q)
    return (signal / size)[..., keep], replace(system, B=B, D=D)


def _energies(signal: Array, batch: EpisodeBatch, known: dict[bytes, BandEnergies] | None) -> BandEnergies:
    key = signal.tobytes()
    if known is not None and key in known:
        return known[key]
    found = BandEnergies.of(signal, batch.lengths, band_edges(_BELOW * int(batch.lengths.max()), _BANDS))
    if known is not None:
        known[key] = found
    return found
