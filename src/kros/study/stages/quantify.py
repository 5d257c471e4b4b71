"""Stage: choose the nominal unit, quantify how the others differ from it, cover that by weights, score every unit."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import save_artifact, write_json
from ...core.errors import IdentificationError
from ...core.frequency import log_grid
from ...core.norms import hinf_norm
from ...identify import ModelSet
from ...uncertainty import OutlierScore, UncertainModel, quantify, residual, score_outliers, sigma_max
from ..config import UncertaintyConfig
from ..context import Context

log = logging.getLogger(__name__)
_LARGEST_PRODUCT = 0.7  # of |W_R W_L|: an amplification by 3.3
Array = npt.NDArray[Any]


def run(context: Context) -> list[Path]:
    """Score outliers first, so that flagged units can be dropped where the study asks for it; then quantify."""
    files, flagged = score_units(context)
    dropped = flagged if context.config.uncertainty.drop_outliers else set()
    units = [u for u in context.facts.pooled if u in context.models(context.model_names[0]).unit_ids and u not in dropped]
    if len(units) < 2:
        raise IdentificationError(
            f"Uncertainty: {len(units)} units are left of {len(context.facts.pooled)}, at least two are needed; dropped are {sorted(dropped)}."
        )
    nominal = context.config.uncertainty.nominal
    folder = context.store.path("uncertainty")
    first: tuple[ModelSet, UncertainModel] | None = None
    for name in context.model_names:
        models = context.models(name)
        uncertain = quantify_models(models, units, context.config.uncertainty, nominal)
        first = first or (models, uncertain)
        nominal = uncertain.nominal_id  # all kinds of models share the nominal unit of the first one, as in the paper
        uncertain.save(folder / name)
        files += sorted((folder / name).iterdir())
    assert first is not None
    save_artifact(folder, "choice", {"nominal": nominal, "worst_off_nominal": worst_off_nominal(*first), "dropped": sorted(dropped)})
    return [*files, folder / "choice.json"]


def quantify_models(models: ModelSet, units: list[str], config: UncertaintyConfig, nominal: str | None) -> UncertainModel:
    """Quantify one kind of model over the pooled units.

    Diagonal weights are tighter than scalar ones channel by channel, but their product can be larger. Inverse forms pay for the product by
    ``1 / (1 - |W_R W_L|)``, so where it comes near one the scalar weights are taken instead.
    """
    if nominal is not None and nominal not in units:
        raise IdentificationError(f"uncertainty.nominal = {nominal!r}: is not among the units {', '.join(units)}; name one of them.")

    def attempt(structure: str) -> UncertainModel:
        return quantify(
            models.systems(units),
            config.form,
            log_grid(models.sample_period_s, config.n_freqs),
            unit_ids=units,
            output_scale=models.output_scale,
            input_scale=models.input_scale,
            nominal=nominal,
            structure=structure,
            max_order=config.max_order,
            tolerance_db=config.tolerance_db,
        )

    if config.structure != "auto":
        return attempt(config.structure)
    diagonal = attempt("diagonal")
    inverse = config.form.startswith("inverse") and config.form != "inverse_additive"
    if not inverse or hinf_norm(diagonal.weight.right @ diagonal.weight.left) < _LARGEST_PRODUCT:
        return diagonal
    log.info("%s: diagonal weights come close to an ill-posed set, scalar ones are taken", models.name)
    return attempt("scalar")


def worst_off_nominal(models: ModelSet, uncertain: UncertainModel) -> str:
    """Return the unit with the largest residual against the nominal one."""
    responses = scaled_responses(models, list(uncertain.unit_ids), uncertain.freqs_hz)
    peaks = sigma_max(residual(uncertain.form, responses[uncertain.nominal], responses)).max(axis=-1)
    peaks[uncertain.nominal] = -np.inf
    return uncertain.unit_ids[int(np.argmax(peaks))]


def scaled_responses(models: ModelSet, units: list[str], freqs_hz: Array) -> Array:
    """Return frequency responses in units of the population's ranges, shape (unit, frequency, n, m)."""
    response = models.systems(units).frequency_response(freqs_hz)
    return response / models.output_scale[:, None] * models.input_scale


def score_units(context: Context) -> tuple[list[Path], set[str]]:
    """Score every unit against the others in every condition, whatever group it is filed under."""
    name = context.edmd_names[0]
    folder = context.store.path("outliers")
    rows: list[dict[str, Any]] = []
    files: list[Path] = []
    for condition in context.population.conditions:
        if not (context.model_folder(name, condition) / "model.json").exists():
            continue
        models = context.models(name, condition)
        if len(models.unit_ids) < 3:
            log.info("%s: outlier scores need at least three units, found %d", condition, len(models.unit_ids))
            continue
        freqs = log_grid(models.sample_period_s, context.config.uncertainty.n_freqs)
        outliers = score_outliers(
            models.systems().frequency_response(freqs),
            freqs,
            context.config.uncertainty.outlier_form,
            unit_ids=models.unit_ids,
            output_scale=models.output_scale,
            input_scale=models.input_scale,
            false_alarm_rate=context.config.uncertainty.false_alarm_rate,
        )
        place = context.model_folder(name, condition).name
        outliers.save(folder / place)
        files += sorted((folder / place).iterdir())
        rows += [score_row(score, condition) for score in outliers.scores]
    write_json(folder / "scores.json", {"schema": 1, "rows": rows})
    return [*files, folder / "scores.json"], {row["unit"] for row in rows if row["outlier"]}


def score_row(score: OutlierScore, condition: str) -> dict[str, Any]:
    """Return a score as a row of metrics, with where it comes from."""
    row = {"unit": score.unit, "condition": condition, "score": score.score_db, "threshold": score.threshold_db, "outlier": score.outlier}
    return row | {"freq_hz": score.freq_hz, "entry": score.entry}
