"""What stands beside the scores of `kros check`: static gains and residual powers of units against the study's, covariates regressed out."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from typing import Any

from ...data import Population
from ...design.unit_quantities import FOLDER, GAINS, POWERS, UnitQuantities
from ...observer import Observer
from ...uncertainty.outliers.quantities import QuantityScore, score_quantities
from ...uncertainty.outliers.score import Status
from ..config import StudyConfig
from ..engine.store import Store

log = logging.getLogger(__name__)


def scores_beside(
    config: StudyConfig,
    store: Store,
    observer: Observer,
    population: Population,
    values: Mapping[str, Mapping[str, float]],
    known: Mapping[tuple[str, str], Collection[str]],
) -> dict[tuple[str, str], dict[str, dict[str, Any]]]:
    """Return what static gains and residual powers say of every unit and condition of some recordings.

    Parameters
    ----------
    config, store
        Of a finished run.
    observer : Observer
        Its deployed one.
    population : Population
        The recordings.
    values : mapping of unit to mapping of str to float
        Lifting parameters of its units.
    known : mapping of (unit, condition) to collection of str
        Units of the study that each is not compared with, beside that of its own name.

    Returns
    -------
    dict
        By unit and condition: ``static_gains`` and ``residual_power``, each the content of a `QuantityScore`. Empty where the run has none of its own units.
    """
    if not store.holds(FOLDER):
        log.warning("Static gains and residual powers: not compared, since the run has none of its own units; run the study again.")
        return {}
    study = UnitQuantities.load(store.path(FOLDER))
    mine = study.ruler.measure(observer, population, {(u, c): keys for u, c, keys in population.groups()}, values)
    return {
        (unit, condition): {
            name: score_quantities(
                study.among(condition, name),
                table.of([k]),
                config.uncertainty.false_alarm_rate,
                {unit, *known.get((unit, condition), ())},
            ).content()
            for name, table in tables.items()
        }
        for condition, tables in mine.items()
        for k, unit in enumerate(next(iter(tables.values())).unit_ids)
    }


def with_beside(row: dict[str, Any], beside: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return a row of `kros check` with what stands beside its score, which flags a unit too; ``outlier_by`` says what did."""
    by = (["monitor" if row.get("score") is None else "model"] if row["outlier"] else []) + [
        n for n, own in beside.items() if own["outlier"]
    ]
    return row | dict(beside) | {"outlier_by": by, "outlier": bool(by), "status": Status.OUTLIER if by else row["status"]}


def beside_lines(row: Mapping[str, Any]) -> list[str]:
    """Return what stands beside a row for people at a terminal."""
    lines = []
    for name in (GAINS, POWERS):
        if name not in row:
            continue
        told, unit = {k: v for k, v in row[name].items() if k != "outlier"}, " dB" if name == POWERS else ""
        own = QuantityScore(**told | {"status": Status(told["status"])})
        title = f"    {name.replace('_', ' ')}  "
        if own.score is None:
            lines.append(f"{title}{Status.CANNOT_TELL.value}: {own.reason}")
            continue
        said = f"{own.status.value.upper() if own.outlier else own.status.value}: {own.quantity} is {own.value:.4g}{unit}, "
        said += f"the other {own.units} say {own.expected:.4g} ± {own.deviation:.2g}{unit}, score {own.score:.2f} (threshold {own.threshold:.2f})"
        said += f", {', '.join(own.covariates)} regressed out" if own.covariates else ""
        lines.append(title + said + (f"; {own.reason}" if own.reason else ""))
    return lines
