r"""Outliers (Appendix A): units whose residual exceeds the cover of the others.

For every pair of units the residual of the form is taken with the one as nominal and the other as perturbed plant. Entries are scaled by
their typical size over the population (Sinkhorn scaling of the median squared magnitudes), and a unit's distance at a frequency is the
median over all nominals of the largest singular value, averaged (in dB) over a third of a decade:

    distance_i(f) = smooth median_(k != i) sigma_max(D_l^-1 E(G_k, G_i) D_r^-1)
    score_i       = max_f ( distance_i(f) - max_(k != i) distance_k(f) ),    dB

No single nominal decides, and the nominal of the study has a score like any other unit. Where the others' cover is more than 40 dB below its
peak, the reference is held there: an excess over next to nothing is noise.

Some unit always exceeds the others, and without a model no threshold can hold a rate below 1 / (N + 1). The threshold is therefore the
upper prediction bound of a normal model of the scores of the inliers, with Student's t for the small number of units, at the stated rate:
an extrapolation, and labelled as such. The unit on top is compared with the bound of the units that stay, and taken out while it is beyond;
two outliers that are alike can hide one another. With three units nothing can be flagged: two scores make no model.

Measured at the default rate of 0.3 % on populations without outlier: 0.3 % of the units flagged with 6 units, 0.6 % with 12, 1.4 % with 38
(the scores have a heavier tail than the normal one). On five simulated populations of 12 drives and one badly assembled one, loaded, additive
form: the planted drive on top in all, flagged in 4 (linear) and 5 (Koopman), no false alarm. The additive form separates best.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, save_artifact
from ..core.errors import ConfigError, DataError, DimensionError
from .forms import Form, as_form, residual
from .residuals import check_responses
from .small import entries_first, sigma_max_first, squared

Array = npt.NDArray[Any]

FALSE_ALARM_RATE = 3e-3
_SMOOTHING_DECADES = 1.0 / 3.0
_FLOOR_DB = 40.0
_FREQUENCIES = 120
_SINKHORN = 50
_SMALLEST = 1e-12  # relative to the largest typical entry


@dataclass(frozen=True)
class OutlierScore:
    """How far one unit exceeds the cover of the others.

    Parameters
    ----------
    unit : str
    score_db : float, dB
        Largest excess over frequency; negative for a unit that the others cover everywhere.
    threshold_db : float, dB
    outlier : bool
    freq_hz : float, Hz
        Where the excess is largest.
    entry : tuple of int
        Row and column of the residual's largest entry there, relative to its typical size.
    """

    unit: str
    score_db: float
    threshold_db: float
    outlier: bool
    freq_hz: float
    entry: tuple[int, int]


@dataclass(frozen=True, eq=False)
class OutlierModel:
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
    extrapolated : bool
        Whether the rate is below 1 / (N + 1), so that it rests on the tail model alone.
    """

    form: Form
    unit_ids: tuple[str, ...]
    freqs_hz: Array
    responses: Array
    output_scale: Array
    input_scale: Array
    scores: tuple[OutlierScore, ...]
    threshold_db: float
    false_alarm_rate: float
    extrapolated: bool

    def score(self, unit: str, response: npt.ArrayLike) -> OutlierScore:
        """Score a new unit.

        Parameters
        ----------
        unit : str
        response : array_like, shape (frequency, p, m), complex
            At `freqs_hz`, in physical units.

        Returns
        -------
        OutlierScore

        Raises
        ------
        DimensionError
            When the response does not have the shape of the population's.
        """
        G = np.asarray(response)
        if G.shape != self.responses.shape[1:]:
            raise DimensionError(
                f"Scoring unit {unit}: needs a response of shape {self.responses.shape[1:]} at the stored frequencies, found {G.shape}."
            )
        G = G / self.output_scale[:, None] * self.input_scale
        everyone = np.concatenate([self.responses, G[None]])
        distance, entries = _distances(self.form, everyone, self.freqs_hz)
        value, where = _excess(distance)
        k = len(everyone) - 1
        row = int(where[k])
        return OutlierScore(
            unit, float(value[k]), self.threshold_db, bool(value[k] > self.threshold_db), float(self.freqs_hz[row]), _entry(entries, k, row)
        )

    def save(self, folder: Path) -> None:
        """Write ``arrays.npz`` and ``outlier_model.json``."""
        content = {
            "form": self.form,
            "unit_ids": self.unit_ids,
            "threshold_db": self.threshold_db,
            "false_alarm_rate": self.false_alarm_rate,
            "extrapolated": self.extrapolated,
            "scores": [{**vars(s), "threshold_db": None} for s in self.scores],
        }
        arrays = {name: getattr(self, name) for name in ("freqs_hz", "responses", "output_scale", "input_scale")}
        save_artifact(Path(folder), "outlier_model", content, arrays)

    @classmethod
    def load(cls, folder: Path) -> OutlierModel:
        """Read what `save` wrote."""
        content, arrays = load_artifact(Path(folder), "outlier_model")
        threshold = float("inf") if content["threshold_db"] is None else content["threshold_db"]
        scores = tuple(OutlierScore(**{**s, "threshold_db": threshold, "entry": tuple(s["entry"])}) for s in content["scores"])
        return cls(
            form=Form(content["form"]),
            unit_ids=tuple(content["unit_ids"]),
            scores=scores,
            threshold_db=threshold,
            false_alarm_rate=content["false_alarm_rate"],
            extrapolated=content["extrapolated"],
            **arrays,
        )


def score_outliers(
    responses: npt.ArrayLike,
    freqs_hz: npt.ArrayLike,
    form: Form | str = Form.ADDITIVE,
    *,
    unit_ids: tuple[str, ...] | None = None,
    output_scale: npt.ArrayLike | None = None,
    input_scale: npt.ArrayLike | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
) -> OutlierModel:
    """Score every unit of a population against the others.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In physical units, of all units; nothing but the responses is looked at.
    freqs_hz : array_like, shape (frequency,), Hz
        Increasing, above zero.
    form : Form or str
    unit_ids : tuple of str, optional
    output_scale, input_scale : array_like, optional
        Ranges, ones by default.
    false_alarm_rate : float
        Nominal rate per unit of the tail model.

    Returns
    -------
    OutlierModel
        With the scores of all units, and the inliers to score new units against.

    Raises
    ------
    DataError
        With fewer than three units there are no others to be covered.
    ConfigError
        When the rate is not between 0 and 1.
    """
    G = check_responses(responses)
    form, freqs = as_form(form), np.asarray(freqs_hz, float)
    ids = tuple(str(k) for k in range(len(G))) if unit_ids is None else tuple(unit_ids)
    if len(G) < 3 or len(ids) != len(G) or freqs.shape != G.shape[1:2]:
        raise DataError(
            f"Outlier scores: need at least three units, one id each, and one frequency for each response; found {len(G)} units, {len(ids)} ids, "
            f"{freqs.size} frequencies for {G.shape[1]}."
        )
    if not 0 < false_alarm_rate < 1 or np.any(np.diff(freqs) <= 0) or freqs[0] <= 0:
        raise ConfigError(
            f"Outlier scores: need a rate between 0 and 1 and increasing positive frequencies, found {false_alarm_rate}, {freqs[:3]}."
        )
    scales = tuple(np.ones(n) if s is None else np.asarray(s, float) for s, n in ((output_scale, G.shape[2]), (input_scale, G.shape[3])))
    rows = np.unique(np.linspace(0, len(freqs) - 1, _FREQUENCIES).round().astype(int))
    freqs, G = freqs[rows], G[:, rows] / scales[0][:, None] * scales[1]
    distance, entries = _distances(form, G, freqs)
    inliers, threshold = _separate(distance, false_alarm_rate)
    scores = []
    for k, unit in enumerate(ids):
        others = np.append(inliers[inliers != k], k)
        value, where = _excess(distance[others])
        row = int(where[-1])
        scores.append(OutlierScore(unit, float(value[-1]), threshold, k not in inliers, float(freqs[row]), _entry(entries, k, row)))
    return OutlierModel(
        form=form,
        unit_ids=tuple(ids[k] for k in inliers),
        freqs_hz=freqs,
        responses=G[inliers],
        output_scale=scales[0],
        input_scale=scales[1],
        scores=tuple(scores),
        threshold_db=threshold,
        false_alarm_rate=false_alarm_rate,
        extrapolated=false_alarm_rate < 1 / (len(inliers) + 1),
    )


def _distances(form: Form, G: Array, freqs: Array) -> tuple[Array, Array]:
    """Distances in dB, shape (unit, frequency), and relative entries, shape (unit, frequency, p', m')."""
    count = len(G)
    E = np.stack([residual(form, G[k], G) for k in range(count)])  # (nominal, perturbed, frequency, p', m')
    pairs = ~np.eye(count, dtype=bool)
    left, right = _typical(np.median(squared(E[pairs]), axis=0))
    scaled = E / left[:, :, None] / right[:, None, :]
    sigma = sigma_max_first(entries_first(scaled))
    sigma[~pairs] = np.nan
    entries = np.abs(scaled)
    entries[~pairs] = np.nan
    floor = np.finfo(float).tiny
    level = 20 * np.log10(np.maximum(np.nanmedian(sigma, axis=0), floor))
    return _smooth(level, freqs), np.nanmedian(entries, axis=0)


def _typical(squares: Array) -> tuple[Array, Array]:
    """Left and right scales that bring squared entries to equal row and column sums, shape (frequency, p') and (frequency, m')."""
    top = squares.max(axis=(1, 2), keepdims=True)
    weights = np.maximum(squares / np.where(top > 0, top, 1.0), _SMALLEST)
    left, right = np.ones(weights.shape[:2]), np.ones((weights.shape[0], weights.shape[2]))
    for _ in range(_SINKHORN):
        left = (weights / right[:, None, :]).sum(axis=2)
        right = (weights / left[:, :, None]).sum(axis=1)
    scale = np.sqrt(np.where(top > 0, top, 1.0))[:, 0]
    return np.sqrt(left) * scale, np.sqrt(right)


def _smooth(level: Array, freqs: Array) -> Array:
    """Moving average over log frequency."""
    x = np.log10(freqs)
    near = (np.abs(x[:, None] - x) <= _SMOOTHING_DECADES / 2).astype(float)
    return level @ (near / near.sum(axis=0))


def _excess(distance: Array) -> tuple[Array, Array]:
    """Largest excess of each unit over the others' cover, dB, and the index of its frequency."""
    order = np.sort(distance, axis=0)
    cover = np.where(distance == order[-1], order[-2], order[-1])  # largest of the others
    cover = np.maximum(cover, cover.max(axis=1, keepdims=True) - _FLOOR_DB)
    excess = distance - cover
    where = excess.argmax(axis=1)
    return excess[np.arange(len(excess)), where], where


def _separate(distance: Array, rate: float) -> tuple[Array, float]:
    """Rows of the inliers, and the prediction bound of their scores, dB.

    The unit with the highest score goes out while it is beyond the bound of those that stay; at most a third goes.
    """
    kept = list(range(len(distance)))
    for _ in range(len(distance) // 3):
        scores = _excess(distance[kept])[0]
        top = int(np.argmax(scores))
        rest = kept[:top] + kept[top + 1 :]
        if scores[top] <= _bound(_excess(distance[rest])[0], rate):
            break
        kept = rest
    return np.array(kept), _bound(_excess(distance[kept])[0], rate)


def _bound(scores: Array, rate: float) -> float:
    """Upper prediction bound for one further score under a normal model."""
    from scipy.stats import t

    count = len(scores)
    if count < 3:
        return float("inf")
    return float(scores.mean() + t.isf(rate, count - 1) * scores.std(ddof=1) * np.sqrt(1 + 1 / count))


def _entry(entries: Array, unit: int, row: int) -> tuple[int, int]:
    i, j = np.unravel_index(int(np.argmax(entries[unit, row])), entries.shape[2:])
    return int(i), int(j)
