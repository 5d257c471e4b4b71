"""Choice of the nominal: the unit, or a model of its own, from which all units differ the least (section IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ..forms import Form, as_form, check_responses, member
from .search import Geometry, search

Array = npt.NDArray[Any]

_FLOOR_DB = -160.0  # smaller magnitudes count as this in a mean


class Criterion(str, Enum):
    """What a good nominal makes small."""

    PEAK = "peak"  # the largest residual over units and frequencies, as the paper
    AREA = "area"  # the mean over log-frequency of the log of the largest residual


@dataclass(frozen=True, eq=False)
class NominalChoice:
    """Best nominal of one form.

    Parameters
    ----------
    form : Form
    index : int
        Row of the chosen candidate: a unit, or from the number of units on one of the further candidates.
    bound : ndarray, shape (frequency,)
        Largest residual over the other units.
    scores_db : ndarray, shape (candidate,), dB
        Criterion of every candidate; minus infinity for the peak of identical units.
    evaluated : ndarray of bool, shape (candidate,)
        Where a score is exact; elsewhere it is a lower bound, which proves that the candidate is no better.
    criterion : Criterion

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import choose_nominal
    >>> choice = choose_nominal(np.array([0.8, 1.0, 1.1]).reshape(3, 1, 1, 1), "additive")
    >>> choice.index, choice.bound.round(9).tolist()
    (1, [0.2])
    """

    form: Form
    index: int
    bound: Array
    scores_db: Array
    evaluated: Array
    criterion: Criterion = Criterion.PEAK

    @property
    def peak_db(self) -> float:
        """Peak of the chosen nominal's bound, dB."""
        with np.errstate(divide="ignore"):
            return float(20 * np.log10(self.bound.max()))


def choose_nominal(
    responses: npt.ArrayLike,
    form: Form | str,
    criterion: Criterion | str = Criterion.PEAK,
    *,
    extra: npt.ArrayLike | None = None,
    freqs_hz: npt.ArrayLike | None = None,
) -> NominalChoice:
    """Return the best nominal of one form; exact, and without visiting all pairs of units.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In scaled coordinates; only pooled units.
    form : Form or str
    criterion : {"peak", "area"}
        Largest residual; mean of its log over log-frequency, where magnitudes below -160 dB count as that. Peaks of different forms do not compare,
        and neither do areas.
    extra : array_like, shape (extra, frequency, p, m), complex, optional
        Responses of candidates that are no units, for example of a pooled model.
    freqs_hz : array_like, shape (frequency,), Hz, optional
        For means over log-frequency; without it all frequencies count alike.

    Raises
    ------
    ConfigError
        When the criterion or form is unknown.
    DimensionError
        When responses of units and candidates do not fit together, or have NaN.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import choose_nominal
    >>> gains = np.array([1.0, 2.0, 9.0]).reshape(3, 1, 1, 1) + 0j
    >>> choose_nominal(gains, "additive").index, choose_nominal(gains, "additive", extra=[[[[5.0]]]]).index
    (1, 3)
    """
    form, criterion = as_form(form), member(Criterion, criterion, "Nominal criterion")
    G, others = _read(responses, extra)
    weights = frequency_weights(G.shape[1], freqs_hz)
    geometry = Geometry.of(form, (G.shape[2], G.shape[3]))
    plants = geometry.plants(np.concatenate([G, others]))
    units = plants.part(slice(0, len(G)))
    floor = 10 ** (_FLOOR_DB / 20)

    def mean(bound: Array) -> Array:
        return np.asarray(np.exp(np.log(np.maximum(bound, floor)) @ weights))

    index, bound, scores, evaluated = search(geometry, plants, units, mean if criterion is Criterion.AREA else lambda b: b.max(axis=-1))
    with np.errstate(divide="ignore"):
        return NominalChoice(form, index, bound, 20 * np.log10(scores), evaluated, criterion)


def choose_nominals(
    responses: npt.ArrayLike,
    *,
    criterion: Criterion | str = Criterion.PEAK,
    extra: npt.ArrayLike | None = None,
    freqs_hz: npt.ArrayLike | None = None,
) -> dict[Form, NominalChoice]:
    """Return the best nominal of every form; arguments and errors as of `choose_nominal`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import Form, choose_nominals
    >>> responses = np.array([0.8, 1.0, 1.1]).reshape(3, 1, 1, 1)
    >>> choose_nominals(responses)[Form.ADDITIVE].index
    1
    """
    return {form: choose_nominal(responses, form, criterion, extra=extra, freqs_hz=freqs_hz) for form in Form}


def frequency_weights(n_freqs: int, freqs_hz: npt.ArrayLike | None = None) -> Array:
    """Return weights of a mean over log-frequency, shape (frequency,), with sum one; even ones without frequencies.

    Zero frequency counts like its neighbour.
    """
    if freqs_hz is None or n_freqs < 3:
        return np.full(n_freqs, 1 / n_freqs)
    freqs = np.asarray(freqs_hz, float)
    if freqs.shape != (n_freqs,):
        raise DimensionError(f"Nominal: responses at {n_freqs} frequencies need as many in freqs_hz, found shape {freqs.shape}.")
    logs = np.log(np.where(freqs > 0, freqs, freqs[freqs > 0].min() ** 2 / freqs[freqs > 0][1]))
    weights = np.gradient(logs)
    return np.asarray(weights / weights.sum())


def _read(responses: npt.ArrayLike, extra: npt.ArrayLike | None) -> tuple[Array, Array]:
    """Responses of units and further candidates."""
    G = check_responses(responses)
    others = np.zeros((0, *G.shape[1:]), complex) if extra is None else np.asarray(extra)
    if others.ndim != 4 or others.shape[1:] != G.shape[1:]:
        raise DimensionError(
            f"Nominal: further candidates need responses like those of the units, (any, {', '.join(map(str, G.shape[1:]))}), found {others.shape}."
        )
    for name, values in (("units", G), ("further candidates", others)):
        broken = ~np.isfinite(values).all(axis=(1, 2, 3))
        if broken.any():
            raise DimensionError(f"Nominal: responses of {name} {np.flatnonzero(broken)[:5]} have NaN or infinity; leave them out.")
    return G, others
