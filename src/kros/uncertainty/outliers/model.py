r"""Outliers (Appendix A): units whose residual exceeds the residuals of the others.

For every pair of units the residual of the form is taken with the one as nominal and the other as perturbed plant
(`distances`). A unit's level at a frequency is the median over all nominals of the largest singular value, relative to
its typical size there and averaged (in dB) over a third of a decade; its excess is what its largest level has beyond
the largest of the others:

    level_i(f) = smooth median_(k != i) sigma_max(D_l^-1 E(G_k, G_i) D_r^-1)
    excess_i   = max_f level_i(f) - max_(k != i) max_f level_k(f),    dB

No single nominal decides; beside the excess stands its range over every unit as the only nominal, as the paper states
its criterion.

Some unit always exceeds the others, and without a model no threshold can hold a rate below 1 / (N + 1). The threshold
rests on an exponential tail of the levels whose scale the others show, the mean over frequency (`score`): an
extrapolation, and labelled as such. Units are taken out one at a time while they are beyond, up to a third of the
units. Fewer than eight units decide nothing. All this compares estimates that are equally good: units that were
recorded for too little are left open before (`population`). What a score would have shown stands beside it (`score`).
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from ...core import AnyArray, ArrayLike, ConfigError, DataError, Names, Storable, frozen
from ...core.linalg import squared
from ..forms import Form, as_form, check_grid, check_responses, evenly
from ..settings import OUTLIER
from .distances import Distances, distances, scaled_levels, typical
from .score import Comparison, OutlierScore, Status
from .tail import LEAST_SCORES, margins, separate


@frozen
class OutlierModel(Storable):
    """Responses of the inliers of a population, against which units are scored.

    Parameters
    ----------
    form : Form
    unit_ids : tuple of str
        Inliers.
    freqs_hz : ndarray, shape (frequency,), Hz
    responses : ndarray, shape (unit, frequency, p, m), complex
        In scaled coordinates.
    output_scale, input_scale : ndarray, shape (p,) and (m,)
    scores : tuple of OutlierScore
        Of all units that were scored when the model was made, outliers among them.
    threshold_db : float, dB
        Infinity where there are too few units.
    false_alarm_rate : float
        Nominal rate per unit.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import score_outliers
    >>> gains = 1 + 0.02 * np.random.default_rng(0).normal(size=(20, 1, 1, 1))
    >>> responses = gains / (1 + 1j * np.geomspace(0.1, 40, 20)[:, None, None])
    >>> score_outliers(responses, np.geomspace(0.1, 40, 20)).score("new", 1.5 * responses[0]).outlier
    True
    """

    KIND = "outlier_model"
    form: Form
    unit_ids: Names
    freqs_hz: AnyArray
    responses: AnyArray
    output_scale: AnyArray
    input_scale: AnyArray
    scores: tuple[OutlierScore, ...]
    threshold_db: float
    false_alarm_rate: float

    def score(
        self, unit: str, response: ArrayLike, without: Collection[str] = (), motion_db: AnyArray | None = None
    ) -> OutlierScore:
        """Score a new unit by its response (frequency, p, m) at `freqs_hz`, in physical units.

        Inliers that are named in `without`, such as the unit itself, are not compared with. Where the unit was moved
        otherwise than the inliers, the level by which responses of one unit differ between motions, `motion_levels`, is
        taken from the unit's levels, in amplitude: a unit that is beyond its bound without this alone has the status
        ``other motions``. Raises a `DimensionError` or `DataError` for a response that is not finite or not like the
        population's, and where fewer than two inliers are left.
        """
        rows = np.array([k for k, other in enumerate(self.unit_ids) if other not in without], dtype=int)
        if len(rows) < 2:
            raise DataError(f"Scoring unit {unit}: {len(rows)} others are left, two are needed; record more units.")
        G = check_responses([*self.responses[:1], response], ("those scored", unit), self.freqs_hz)[1]
        G = G / self.output_scale[:, None] * self.input_scale
        responses = self.responses[rows]
        known = self._known if len(rows) == len(self.unit_ids) else distances(self.form, responses, self.freqs_hz)
        levels = scaled_levels(self.form, responses[known.nominals], G, known, self.freqs_hz)
        peaks = np.hstack([known.peaks, levels.max(axis=1)[:, None]])
        found = replace(known, peaks=peaks, levels=np.vstack([known.levels, np.median(levels, axis=0)]))
        everyone, inliers = np.concatenate([responses, G[None]]), np.arange(len(rows) + 1) < len(rows)
        comparison = Comparison(self.form, everyone, self.freqs_hz, found, inliers, self.false_alarm_rate)
        beyond = margins(found.levels, inliers, self.false_alarm_rate)[1][-1:]
        (score,) = comparison.scores((unit,), self.threshold_db, beyond)
        level = found.levels[-1]
        motion = 0.0 if motion_db is None else 10 ** (motion_db / 20)
        rest = np.maximum(10 ** (level / 20) - motion, OUTLIER.least)
        other = score.outlier and beyond[0] <= level.max() - 20 * np.log10(rest.max())
        return replace(score, outlier=False, status=Status.OTHER_MOTIONS) if other else score

    def motion_levels(self, one: AnyArray, other: AnyArray) -> AnyArray:
        """Return the level, shape (frequency,), dB, by which estimates differ where motions do.

        Responses have the shape (unit, frequency, p, m); the median over the units counts. Halves scatter twice as much
        as the whole, in variance.
        """
        first, second = (G / self.output_scale[:, None] * self.input_scale for G in (one, other))
        levels = scaled_levels(self.form, first, second, self._known, self.freqs_hz)
        return np.median(levels, axis=0) - 10 * np.log10(2.0)

    @property
    def extrapolated(self) -> bool:
        """Whether the rate is below 1 / (N + 1), so that it rests on the tail model alone."""
        return self.false_alarm_rate < 1 / (len(self.unit_ids) + 1)

    @cached_property
    def _known(self) -> Distances:
        return distances(self.form, self.responses, self.freqs_hz)


def score_outliers(
    responses: ArrayLike | Sequence[ArrayLike],
    freqs_hz: ArrayLike,
    form: Form | str = Form.ADDITIVE,
    *,
    unit_ids: Names | None = None,
    false_alarm_rate: float = 0.01,
) -> OutlierModel:
    """Score every unit of a population against the others.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In any units of measure, which do not matter: outputs and inputs are scaled such that the responses' typical
        entries are equal. Nothing but the responses is looked at.
    freqs_hz : array_like, shape (frequency,), Hz
        Increasing, above zero.
    form : Form or str
    unit_ids : tuple of str, optional
    false_alarm_rate : float
        Nominal rate per unit of the tail model.

    Returns
    -------
    OutlierModel
        With the scores of all units, and the inliers to score new units against.

    Raises
    ------
    DataError
        With fewer than three units there are no others to be covered; when a response is not finite.
    DimensionError
        When units have responses of different shapes.
    ConfigError
        When the rate is not between 0 and 1.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import score_outliers
    >>> gains, freqs_hz = np.random.default_rng(0).normal(1, 0.02, size=(21, 1, 1, 1)), np.geomspace(0.1, 40, 20)
    >>> gains[20] = 1.5
    >>> model = score_outliers(gains / (1 + 1j * freqs_hz[:, None, None]), freqs_hz)
    >>> [score.unit for score in model.scores if score.outlier]
    ['20']
    """
    freqs = check_grid(freqs_hz, None)
    G = check_responses(responses, unit_ids, freqs)
    if len(G) < LEAST_SCORES:
        raise DataError(f"Outlier scores: need at least {LEAST_SCORES} units, found {len(G)}.")
    if freqs[0] == 0:
        raise ConfigError("Outlier scores: need frequencies above zero.")
    ids = unit_ids or tuple(map(str, range(len(G))))
    form, rate = as_form(form), float(false_alarm_rate)
    if not 0 < rate < 1:
        raise ConfigError(f"Outlier scores: need a false alarm rate between 0 and 1, found {rate}; 0.01 is usual.")
    rows = evenly(len(freqs), OUTLIER.frequencies)
    freqs, G = freqs[rows], G[:, rows]
    (left,), (right,) = typical(np.median(squared(G), axis=(0, 1))[None])
    scales = left, 1 / right
    G = G / left[:, None] * scales[1]
    found = distances(form, G, freqs)
    parts = separate(found.levels, rate)
    inliers = np.flatnonzero(parts.inliers)
    scores = Comparison(form, G, freqs, found, parts.inliers, rate).scores(ids, parts.threshold_db, parts.margin_db)
    names = tuple(ids[k] for k in inliers)
    return OutlierModel(form, names, freqs, G[inliers], *scales, scores, parts.threshold_db, rate)
