"""Choice of the nominal: the unit, or a model of its own, from which all units differ the least (section IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, DimensionError
from ..forms import Form, as_form
from ..residuals import all_bounds, bounds, check_responses
from ..weights.cover import Structure, as_structure
from ..weights.cover_search import FLOOR_DB, search_cover
from .search import Found, Geometry, Plants, bound_of, first_best, search

Array = npt.NDArray[Any]

_ALL_PAIRS = 64  # up to so many units, all pairs for all six forms take no longer than six searches


class Criterion(str, Enum):
    """What a good nominal makes small."""

    PEAK = "peak"  # the largest residual over units and frequencies, as the paper
    AREA = "area"  # the mean over log-frequency of the log of the largest residual
    COST = "cost"  # the mean over log-frequency of the log magnitudes of the optimal cover


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
        Criterion of every candidate; infinity for those that are none, minus infinity for the peak of identical units.
    evaluated : ndarray of bool, shape (candidate,)
        Where a score is exact; elsewhere it is a lower bound, which proves that the candidate is no better.
    criterion : Criterion
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

    @property
    def score_db(self) -> float:
        """Criterion of the chosen nominal, dB."""
        return float(self.scores_db[self.index])

    def runner_up(self) -> int:
        """Return the second-best evaluated candidate, or the best where there is no other."""
        order = np.argsort(np.where(self.evaluated, self.scores_db, np.inf), kind="stable")
        rest = order[order != self.index]
        return int(rest[0]) if rest.size and np.isfinite(self.scores_db[rest[0]]) else self.index


def choose_nominal(
    responses: npt.ArrayLike,
    form: Form | str,
    criterion: Criterion | str = Criterion.PEAK,
    *,
    extra: npt.ArrayLike | None = None,
    candidates: npt.ArrayLike | None = None,
    freqs_hz: npt.ArrayLike | None = None,
    structure: Structure | str = Structure.DIAGONAL,
) -> NominalChoice:
    """Return the best nominal of one form; exact, and without visiting all pairs of units.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In scaled coordinates; only pooled units.
    form : Form or str
    criterion : {"peak", "area", "cost"}
        Largest residual; mean of its log over log-frequency; mean over log-frequency of the optimal cover's log magnitudes. Magnitudes below
        -160 dB count as that in a mean. Peaks of different forms do not compare, and neither do areas. A cover is computed for every candidate that
        cannot be excluded by its entries: seconds for tens of units, minutes for hundreds.
    extra : array_like, shape (extra, frequency, p, m), complex, optional
        Responses of candidates that are no units, for example of a pooled model.
    candidates : array_like of bool, shape (unit,), optional
        Which units may be nominal; none is allowed if there are further candidates.
    freqs_hz : array_like, shape (frequency,), Hz, optional
        For means over log-frequency; without it all frequencies count alike.
    structure : {"diagonal", "scalar", "full", "entrywise"}
        Of the cover whose cost counts; with full and entrywise weights that of the diagonal one.

    Returns
    -------
    NominalChoice

    Raises
    ------
    ConfigError
        When there is no candidate, or the criterion or form is unknown.
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
    form, criterion, structure = as_form(form), as_criterion(criterion), as_structure(structure)
    G, others, allowed = _read(responses, extra, candidates)
    weights = frequency_weights(G.shape[1], freqs_hz)
    if criterion is Criterion.COST and structure is not Structure.SCALAR:
        found = search_cover(form, G, others, allowed, weights, structure)
        return NominalChoice(form, found.index, found.bound, found.scores, found.evaluated, criterion)
    geometry = Geometry.of(form, (G.shape[2], G.shape[3]))
    units = geometry.plants(G)
    plants = _joined(units, geometry.plants(others)) if len(others) else units
    if criterion is Criterion.PEAK:
        found = search(geometry, plants, units, allowed, _peak, partial=True)
    else:
        found = search(geometry, plants, units, allowed, lambda b: _geometric_mean(b, weights), partial=False)
    return _choice(form, criterion, found)


def choose_nominals(
    responses: npt.ArrayLike,
    *,
    criterion: Criterion | str = Criterion.PEAK,
    extra: npt.ArrayLike | None = None,
    candidates: npt.ArrayLike | None = None,
    freqs_hz: npt.ArrayLike | None = None,
    paper: bool = False,
) -> dict[Form, NominalChoice]:
    """Return the best nominal of every form.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In scaled coordinates; only pooled units.
    criterion : {"peak", "area", "cost"}
        As in `choose_nominal`.
    extra : array_like, shape (extra, frequency, p, m), complex, optional
        Responses of candidates that are no units.
    candidates : array_like of bool, shape (unit,), optional
        Which units may be nominal.
    freqs_hz : array_like, shape (frequency,), Hz, optional
        For means over log-frequency.
    paper : bool
        The published pipeline's residuals and its peaks (slow; no further candidates).

    Returns
    -------
    dict of Form to NominalChoice
        With up to 64 units all scores are exact, except those by cost.

    Raises
    ------
    ConfigError
        When no unit may be nominal, or the paper's residuals are asked for with another criterion or further candidates.
    """
    criterion = as_criterion(criterion)
    G, others, allowed = _read(responses, extra, candidates)
    if paper and (len(others) or criterion is not Criterion.PEAK):
        raise ConfigError(
            f"Nominal: the paper's residuals go with peaks over the units, found {criterion.value!r} and {len(others)} further candidates; drop paper or these."
        )
    if criterion is Criterion.COST or (len(G) > _ALL_PAIRS and not paper):
        return {form: choose_nominal(G, form, criterion, extra=extra, candidates=candidates, freqs_hz=freqs_hz) for form in Form}
    weights = frequency_weights(G.shape[1], freqs_hz)
    found = {form: bounds(form, G, paper=True) for form in Form} if paper else all_bounds(G)
    choices = {}
    for form, of_units in found.items():
        bound = np.concatenate([of_units, _bounds_of(form, G, others)])
        scores = np.where(allowed, _peak(bound) if criterion is Criterion.PEAK else _geometric_mean(bound, weights), np.inf)
        index = first_best(scores)
        choices[form] = _choice(form, criterion, Found(index, bound[index], scores, allowed))
    return choices


def as_criterion(criterion: Criterion | str) -> Criterion:
    """Return the criterion of a name.

    Raises
    ------
    ConfigError
        When there is no criterion of that name.
    """
    try:
        return Criterion(criterion)
    except ValueError as error:
        raise ConfigError(f"Nominal criterion {criterion!r} is unknown; choose 'peak', 'area' or 'cost'.") from error


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


def _read(responses: npt.ArrayLike, extra: npt.ArrayLike | None, candidates: npt.ArrayLike | None) -> tuple[Array, Array, Array]:
    """Responses of units and further candidates, and which of all may be nominal."""
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
    allowed = np.ones(len(G), bool) if candidates is None else np.asarray(candidates, bool)
    if allowed.shape != (len(G),) or not (allowed.any() or len(others)):
        raise ConfigError(f"Nominal: candidates should mark at least one of {len(G)} units, found shape {allowed.shape}.")
    return G, others, np.concatenate([allowed, np.ones(len(others), bool)])


def _joined(first: Plants, second: Plants) -> Plants:
    def both(a: Array | None, b: Array | None) -> Array | None:
        return None if a is None or b is None else np.concatenate([a, b], axis=2)

    return Plants(np.concatenate([first.G, second.G], axis=2), both(first.P, second.P), both(first.L, second.L))


def _bounds_of(form: Form, responses: Array, others: Array) -> Array:
    """Bounds of candidates that are no units, shape (extra, frequency)."""
    if not len(others):
        return np.zeros((0, responses.shape[1]))
    geometry = Geometry.of(form, (responses.shape[2], responses.shape[3]))
    units, plants = geometry.plants(responses), geometry.plants(others)
    return np.stack([bound_of(geometry, plants.one(row), units)[0] for row in range(len(others))])


def _choice(form: Form, criterion: Criterion, found: Found) -> NominalChoice:
    with np.errstate(divide="ignore"):
        return NominalChoice(form, found.index, found.bound, 20 * np.log10(found.scores), found.evaluated, criterion)


def _peak(bound: Array) -> Array:
    return np.asarray(bound.max(axis=-1))


def _geometric_mean(bound: Array, weights: Array) -> Array:
    return np.asarray(np.exp(np.log(np.maximum(bound, 10 ** (FLOOR_DB / 20))) @ weights))
