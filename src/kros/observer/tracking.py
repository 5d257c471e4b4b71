r"""A phase-locked loop: a lifting parameter, such as the phase of a gearbox, follows the machine while the observer runs.

With the parameter p of the running observer, the sensitivity ``s = d x_hat / d p`` obeys the linearised observer itself,

    s+ = (A_s + a sigma_x) s + a sigma_p - (into D^c C)_s s + (into C^c)_s s_c,      s_c+ = A^c s_c - B^c C s,

and ``psi = C s`` says how the predicted measurement moves with p, delays of the machine included: for ``sin(100 position + phase)`` it is the cosine of the
gearbox angle, filtered as the machine filters it, whichever way it turns. The innovation times psi is integrated with a small gain,

    p+ = p + (dt / tau) psi nu / r,      r the mean of psi^2 over about tau,

so that an error of p decays in the time tau while psi is excited, the integrand kept within 1. Several measurements count in units of their scale.

References
----------
L. Ljung and T. Soderstrom, Theory and Practice of Recursive Identification, MIT Press 1983, section 3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .data import ObserverData
from .screen import screened
from .step import Steps

Array = npt.NDArray[np.float64]
_STEP = 1e-5
_MOST = 1.0  # largest error of the parameter that is corrected at once: transients at the start show more


@dataclass(frozen=True, eq=False)
class Tracked:
    """What a run with a phase-locked loop leaves.

    Parameters
    ----------
    estimates : ndarray, shape (n_samples, batch, n)
        Row k from what arrived up to k - 1.
    values : ndarray, shape (n_samples, batch)
        The parameter, row k from what arrived up to k - 1.
    """

    estimates: Array
    values: Array


def track_parameter(
    observer: ObserverData,
    y: Array,
    u: Array,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    name: str = "phase",
    settle_s: float = 2.0,
) -> Tracked:
    """Run an observer that follows one of its lifting's parameters.

    Parameters
    ----------
    observer : ObserverData
        Without delays in its lifting, delay of the measurement and limits.
    y : ndarray, shape (n_samples, batch, q)
        NaN where a measurement is missing: neither the estimate nor the parameter is corrected then.
    u : ndarray, shape (n_samples, batch, m)
    parameters : mapping of str to array_like, shape (batch,)
        Where every parameter starts; the observer's own values where absent.
    name : str
        The parameter that is followed.
    settle_s : float, s
        Time tau in which its error decays; long against the vibration that shows it.

    Returns
    -------
    Tracked

    Raises
    ------
    ConfigError
        When the lifting has no such parameter, a parameter is unknown or not finite, or the observer has delays.
    """
    lifting = observer.lifting
    if name not in lifting.parameters or lifting.history or lifting.input_functions or observer.runtime.delay:
        raise ConfigError(
            f"Phase-locked loop of observer {observer.name}: needs a lifting of present states with the parameter {name!r} and measurements without delay, "
            f"found parameters {lifting.parameters}, a history of {lifting.history} and a delay of {observer.runtime.delay}."
        )
    samples, values = screened(observer, y, u), observer.values(parameters, np.shape(y)[1:2])
    y, u, starts = samples.y, samples.u, samples.starts
    K, n, batch, C = observer.controller, lifting.n_states, y.shape[1], list(observer.measured)
    values = {k: np.broadcast_to(np.asarray(v, dtype=float), (batch,)).copy() for k, v in values.items()}
    forget = min(observer.sample_period_s / settle_s, 1.0)
    coupling, into = observer.A[:n, n:], observer.into[:n]
    steps, missing = Steps([observer], batch, values), ~np.isfinite(y)
    s, s_c, power, age = np.zeros((batch, n)), np.zeros((batch, K.n_states)), np.zeros(batch), np.zeros(batch, dtype=int)
    estimates, followed = np.empty((*y.shape[:2], n)), np.empty(y.shape[:2])
    scale = np.max(y, axis=(0, 1), where=~missing, initial=-np.inf) - np.min(y, axis=(0, 1), where=~missing, initial=np.inf)
    scale = np.where(scale > 0, scale, 1.0)
    steps.begin(y[0])
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for k in range(len(y)):
            estimates[k], followed[k] = observer.runtime.clip_estimate(steps.x[0]), values[name]
            if k and starts[k].any():  # the parameter stays
                steps.begin(y[k], starts[k])
                s[starts[k]], s_c[starts[k]], power[starts[k]], age[starts[k]] = 0.0, 0.0, 0.0, 0
            age += 1
            x, nu, psi = steps.x[0].copy(), steps.innovation(y[k])[0], s[:, C]
            by_state = lifting.slopes(x, values)[..., :n]
            ahead, behind = ({**values, name: values[name] + h} for h in (_STEP, -_STEP))
            by_value = (lifting.lift(x, ahead) - lifting.lift(x, behind))[:, n:] / (2 * _STEP)
            power += forget * (np.sum((psi / scale) ** 2, axis=-1) - power)
            pull = np.sum(psi * nu / scale**2, axis=-1) * (1 - (1 - forget) ** age)  # over the mean of psi^2 so far
            steps.step(y[k], u[k], missing[k] if missing[k].any() else None)
            moved = ((observer.A[:n, :n] + coupling @ by_state) @ s[..., None])[..., 0] + by_value @ coupling.T
            s, s_c = moved + (s_c @ K.C.T - psi @ K.D.T) @ into.T, s_c @ K.A.T - psi @ K.B.T
            seen = np.divide(pull, power, out=np.zeros(batch), where=(power > 0) & np.isfinite(pull))
            values[name] = values[name] + forget * np.clip(seen, -_MOST, _MOST)
    return Tracked(estimates, followed)
