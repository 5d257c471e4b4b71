r"""Single quantities of units, such as static gains and residual powers, against those of a population, with recorded covariates regressed out.

Over the N units of the population every quantity q is fitted by ``q = b_0 + b' c``, c the means of what was recorded beside: load, supply, temperature. Of
each unit, and of the new one, counts how far it is from what *the others* say,

.. math:: t = \frac{q - \hat q}{\sqrt{s^2 (1 + h) + \sigma^2}},

s the others' deviation from their fit, h the leverage of the unit's covariates among theirs, :math:`\sigma` what the unit's own recordings leave unknown beyond
those of the others. A unit's score is the largest of ``|t|`` over its quantities. Scores of good units are draws with the tail of all outlier scores
(`tail`), whatever distribution the quantities have: the threshold is what one more exceeds with the stated probability. Units that are beyond it, one at a
time, are taken out of the population first.

A unit whose covariates the population does not cover has no score: nothing is extrapolated.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .score import Status
from .tail import leave_one_out_bounds, prediction_bound

Array = npt.NDArray[np.float64]
FEWEST = 8  # units beside the covariates, to tell anything
KNOWN = 0.75  # of the units, that a quantity has to be known of


@dataclass(frozen=True, eq=False)
class Quantities:
    """Quantities of some units in one condition."""

    unit_ids: tuple[str, ...]
    names: tuple[str, ...]  # of the quantities
    values: Array  # (unit, quantity): naN where a quantity is not known; deviations are those of its estimate
    deviations: Array  # (unit, quantity): naN where a quantity is not known; deviations are those of its estimate
    floor: Array  # (quantity,): differences that nobody looks at
    covariates: Mapping[str, Array]  # (unit,): mean of what was recorded beside; NaN where it was not recorded

    def of(self, rows: Any) -> Quantities:
        """Return those of some units."""
        covariates = {name: own[rows] for name, own in self.covariates.items()}
        ids = tuple(np.array(self.unit_ids, dtype=object)[rows])
        return Quantities(ids, self.names, self.values[rows], self.deviations[rows], self.floor, covariates)


@dataclass(frozen=True)
class QuantityScore:
    """What single quantities say of one unit."""

    status: Status  # ``cannot tell`` where no score stands
    score: float | None = None  # deviations from what the others say, and what one more good unit exceeds with the stated probability
    threshold: float | None = None  # deviations from what the others say, and what one more good unit exceeds with the stated probability
    quantity: str | None = None
    value: float | None = None
    expected: float | None = None
    deviation: float | None = None
    units: int = 0  # that it was compared with
    covariates: tuple[str, ...] = ()  # regressed out
    reason: str = ""  # why there is no score, or what was not regressed out

    @property
    def outlier(self) -> bool:
        """Whether the unit is beyond the threshold."""
        return self.status is Status.OUTLIER

    def content(self) -> dict[str, Any]:
        """Return it as a row of JSON."""
        return {**vars(self), "status": self.status.value, "outlier": self.outlier, "covariates": list(self.covariates)}


def score_quantities(population: Quantities, unit: Quantities, rate: float, without: Collection[str] = ()) -> QuantityScore:
    """Score one unit against a population without some units; the rate is that with which one more good unit is flagged."""
    here = population.of([k for k, name in enumerate(population.unit_ids) if name not in without])
    names, reason = _shared(here, unit)
    often = np.count_nonzero(np.isfinite(here.values), axis=0) >= KNOWN * len(here.unit_ids)
    at = np.flatnonzero(np.isfinite(unit.values[0]) & often).tolist()
    known = np.isfinite(np.column_stack([here.values[:, at], *(here.covariates[c] for c in names)])).all(axis=1)
    here, few = here.of(known), FEWEST + len(names)
    if not at or len(here.unit_ids) < few:
        said = f"too few units to tell: {len(here.unit_ids)} of {few}" if at else "none is known of the unit and of most others"
        return QuantityScore(Status.CANNOT_TELL, units=len(here.unit_ids), reason=said)
    c, own = (np.stack([q.covariates[name] for name in names], axis=1) if names else np.zeros((len(q.unit_ids), 0)) for q in (here, unit))
    q, noise, floor = here.values[:, at], np.nan_to_num(here.deviations[:, at]) ** 2, here.floor[at]
    while True:
        away, kept = _outside(dict(zip(names, c.T, strict=True)), dict(zip(names, own[0], strict=True)))
        if away:
            return QuantityScore(Status.CANNOT_TELL, units=len(c), reason=away)
        X, x = _regressors(c[:, kept], own[0, kept])
        scores = np.abs(_deleted(X, q, floor, noise)).max(axis=1)
        beyond = scores - leave_one_out_bounds(scores, rate)
        if beyond.max() <= 0 or len(c) <= few:
            break
        stay = np.arange(len(c)) != int(beyond.argmax())
        c, q, noise = c[stay], q[stay], noise[stay]
    expected, deviation = _predicted(X, x, q, floor, noise, np.nan_to_num(unit.deviations[0, at]) ** 2)
    t, threshold = np.abs(unit.values[0, at] - expected) / deviation, float(prediction_bound(scores, rate))
    k = int(t.argmax())
    return QuantityScore(
        Status.OUTLIER if t[k] > threshold else Status.OK,
        float(t[k]),
        threshold,
        here.names[at[k]],
        float(unit.values[0, at[k]]),
        float(expected[k]),
        float(deviation[k]),
        len(c),
        tuple(name for name, keep in zip(names, kept, strict=True) if keep),
        reason,
    )


def _shared(population: Quantities, unit: Quantities) -> tuple[list[str], str]:
    """Covariates that are known of both, and what is said of others."""
    known = {name for name, own in population.covariates.items() if np.isfinite(own).mean() >= KNOWN}
    theirs = {name for name, own in unit.covariates.items() if np.isfinite(own).all()}
    alone = [f"{name} was not recorded {'of the unit' if name in known else 'in the study'}" for name in sorted(known ^ theirs)]
    return sorted(known & theirs), "; ".join(alone)


def _outside(theirs: Mapping[str, Array], own: Mapping[str, float]) -> tuple[str, list[bool]]:
    """Say which covariate the units do not cover, up to a mean gap between them; and which of them differ, and can be regressed out."""
    kept = []
    for name, values in theirs.items():
        low, high = float(values.min()), float(values.max())
        same = high - low <= 1e-9 * max(abs(low), abs(high))
        room = 1e-6 * abs(high) if same else (high - low) / (len(values) - 1)
        if not low - room <= own[name] <= high + room:
            return f"{name} is {own[name]:.4g}, and the units cover {low:.4g} to {high:.4g}", []
        kept.append(not same)
    return "", kept


def _regressors(c: Array, own: Array) -> tuple[Array, Array]:
    """Return ``[1, c]`` of the units, shape (unit, 1 + covariates), and of the new one, in the covariates' ranges."""
    middle, size = c.mean(axis=0), np.ptp(c, axis=0)
    return np.column_stack([np.ones(len(c)), (c - middle) / size]), np.concatenate([[1.0], (own - middle) / size])


def _fit(X: Array, q: Array) -> tuple[Array, Array, Array]:
    """Coefficients, residuals and leverages."""
    inverse = np.linalg.pinv(X)
    b = inverse @ q
    return b, q - X @ b, np.einsum("ij,ji->i", X, inverse)


def _deleted(X: Array, q: Array, floor: Array, noise: Array) -> Array:
    """How far every unit is from what the others say, shape (unit, quantity)."""
    (n, p), (_, e, h) = X.shape, _fit(X, q)
    left = np.maximum(1 - h, 1e-9)[:, None]
    others = np.maximum((e**2).sum(axis=0) - e**2 / left, 0.0) / (n - p - 1)  # their variance without the unit
    more = np.maximum(noise - (noise.sum(axis=0) - noise) / (n - 1), 0.0)
    return np.asarray(e / left / np.sqrt(others / left + floor**2 + more))


def _predicted(X: Array, x: Array, q: Array, floor: Array, noise: Array, own: Array) -> tuple[Array, Array]:
    """What a further unit should have, and the deviation of its difference."""
    (n, p), (b, e, _) = X.shape, _fit(X, q)
    leverage = float(x @ np.linalg.pinv(X.T @ X) @ x)
    more = np.maximum(own - noise.mean(axis=0), 0.0)
    return x @ b, np.sqrt((e**2).sum(axis=0) / (n - p) * (1 + leverage) + floor**2 + more)
