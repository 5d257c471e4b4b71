"""Errors against severity: estimators on disturbed measurements of a few episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..data.batch import EpisodeBatch
from .disturb import Disturbance, Measured
from .errors import error_percent

Array = npt.NDArray[np.float64]
Run = Callable[[Measured, Array], Sequence[Array] | Array]
_AT_ONCE = 20_000_000  # numbers of all estimates that are in memory, 160 MB


@dataclass(frozen=True, eq=False)
class DisturbedEpisodes:
    """Episodes that observers run on under a list of disturbances.

    Parameters
    ----------
    batch : EpisodeBatch
        With the calibrated lifting parameters of the machine behind every episode.
    measured : tuple of int
    disturbances : tuple of Disturbance
    seed : int

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.evaluate import Disturbance, DisturbedEpisodes
    >>> arrays = {unit: [np.random.default_rng(0).normal(size=(50, 2))] for unit in ("a", "b")}
    >>> population = kros.from_arrays(arrays, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> batch = kros.data.EpisodeBatch.read(population, population.keys())
    >>> episodes = DisturbedEpisodes(batch, (0,), (Disturbance("bias", 0.1),))
    >>> # with the measurement as the estimate: disturbance, episode, state
    >>> episodes.errors(lambda given, inputs: given.y[None]).round(1).tolist()
    [[[[0.0], [0.0]], [[10.0], [10.0]]]]
    """

    batch: EpisodeBatch
    measured: tuple[int, ...]
    disturbances: tuple[Disturbance, ...]
    seed: int = 0

    @property
    def given(self) -> Measured:
        """Measurements as the sensor shows them; their range is the largest value of all recorded episodes."""
        size = np.abs(self.batch.states[..., list(self.measured)]).max(axis=(0, 1))
        return Measured(self.batch.measurements(self.measured), self.batch.parameters, size)

    def errors(self, run: Run, estimators: int = 1) -> Array:
        """Run estimators on all episodes under all disturbances.

        Parameters
        ----------
        run : callable
            Takes measurements and inputs (n_samples, batch, m) and returns the estimates of every estimator, shape
            (estimator, n_samples, batch, ...); internal states are left out.
        estimators : int
            How many `run` returns, which limits what is run at once.

        Returns
        -------
        ndarray, shape (estimator, 1 + disturbance, batch, n)
            ``100 rms(x_hat - x) / max|x|``; first of the measurements as they are. Not finite where an estimate
            diverged or there is none.
        """
        batch, given = self.batch, self.given
        n, pieces = batch.states.shape[-1], []
        together = max(1, _AT_ONCE // (estimators * batch.states.size))
        everything = (None, *self.disturbances)
        for start in range(0, len(everything), together):
            wanted = everything[start : start + together]
            estimates = run(given.under(wanted, self.seed), np.tile(batch.inputs, (1, len(wanted), 1)))
            pieces.append([self._percent(estimate[..., :n], len(wanted)) for estimate in estimates])
        return np.concatenate([np.array(piece) for piece in pieces], axis=1)

    def _percent(self, estimate: Array, count: int) -> Array:
        width = len(self.batch.keys)
        if estimate.shape[1] != count * width:
            raise DimensionError(
                f"Disturbed episodes: expected estimates of {count * width} episodes, found {estimate.shape}."
            )
        parts = [estimate[:, i * width : (i + 1) * width] for i in range(count)]
        return np.stack([error_percent(part, self.batch.states, self.batch.lengths) for part in parts])


def robustness_rows(
    name: str,
    errors: Array,
    episodes: DisturbedEpisodes,
    channels: Sequence[str],
    estimated: Sequence[int] | None = None,
) -> list[dict[str, Any]]:
    """Return a row a disturbance, severity, condition and channel: mean and worst unit, first draws alone.

    Parameters
    ----------
    name : str
        Of the observer.
    errors : ndarray, shape (1 + disturbance, batch, n)
    episodes : DisturbedEpisodes
    channels : sequence of str, length n
    estimated : sequence of int, optional
        Channels that the observer estimates; default all.

    Returns
    -------
    list of dict
        ``disturbance`` is "none" and ``severity`` 0 for the measurements as they are; errors are None where an estimate
        diverged.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.evaluate import Disturbance, DisturbedEpisodes, robustness_rows
    >>> arrays = {unit: [np.random.default_rng(0).normal(size=(50, 2))] for unit in ("a", "b")}
    >>> population = kros.from_arrays(arrays, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> batch = kros.data.EpisodeBatch.read(population, population.keys())
    >>> episodes = DisturbedEpisodes(batch, (0,), (Disturbance("bias", 0.1),))
    >>> errors = episodes.errors(lambda given, inputs: given.y[None])[0]
    >>> rows = robustness_rows("measurement", errors, episodes, population.states)
    >>> [(row["disturbance"], row["severity"]) for row in rows]
    [('none', 0.0), ('bias', 0.1)]
    """
    keys, rows = episodes.batch.keys, []
    severities = [(0, "none", 0.0)] + [
        (i, d.kind.value, float(d.severity)) for i, d in enumerate(episodes.disturbances, 1) if not d.draw
    ]
    for condition in dict.fromkeys(k.condition for k in keys):
        units = {
            u: [i for i, k in enumerate(keys) if (k.unit, k.condition) == (u, condition)]
            for u in dict.fromkeys(k.unit for k in keys)
        }
        per_unit = np.stack(
            [errors[:, chosen].mean(axis=1) for chosen in units.values() if chosen]
        )  # (unit, 1 + disturbance, n)
        for i, kind, severity in severities:
            for j in range(len(channels)) if estimated is None else estimated:
                values = per_unit[:, i, j]
                known = bool(np.isfinite(values).all())
                error = {
                    "mean": float(values.mean()) if known else None,
                    "worst": float(values.max()) if known else None,
                }
                row = {
                    "observer": name,
                    "disturbance": kind,
                    "severity": severity,
                    "condition": condition,
                    "channel": channels[j],
                }
                rows.append(row | {"error_percent": error})
    return rows


def severity_of_growth(severities: npt.ArrayLike, errors: npt.ArrayLike, factor: float = 2.0) -> float:
    """Return the severity at which an error reaches a multiple of that without disturbance."""
    s, e = np.asarray(severities, dtype=float), np.asarray(errors, dtype=float)
    if s.shape != e.shape or s.ndim != 1 or not len(s) or s[0] != 0:
        raise DimensionError(
            f"Severity of growth: severities {s} should begin at zero, with as many errors, found {e.shape}."
        )
    limit = factor * e[0]
    beyond = np.flatnonzero(~(e < limit))
    if not len(beyond) or beyond[0] == 0:
        return np.inf if not len(beyond) else 0.0
    k = beyond[0]
    share = (limit**2 - e[k - 1] ** 2) / (e[k] ** 2 - e[k - 1] ** 2) if np.isfinite(e[k]) else 1.0
    return float(np.sqrt(s[k - 1] ** 2 + share * (s[k] ** 2 - s[k - 1] ** 2)))
