"""What a study tells about its uncertainty beside the weights: from stored factors, and in the run folder alone."""

from __future__ import annotations

import numpy as np
import pytest

from kros.identify import ModelSet
from kros.study.context import Context, Silent
from kros.study.executors import open_executor
from kros.study.pipeline import load_run
from kros.study.resampling import resampled_models
from kros.uncertainty import Tightness, UncertainModel, VariationAndNoise
from kros.uncertainty.population.unit_residuals import UnitResiduals

KINDS = ("koopman", "linear", "koopman_edmd", "linear_edmd")


@pytest.mark.parametrize("name", KINDS)
def test_noise_and_orders_are_kept_and_summarised(demo, metrics, name):
    noise = VariationAndNoise.load(demo / "uncertainty" / name / "noise")
    uncertain = UncertainModel.load(demo / "uncertainty" / name)
    assert noise.unit_ids == uncertain.unit_ids
    assert noise.unit_ids[noise.nominal] == uncertain.nominal_id
    share = metrics["uncertainty"][name]["noise_share"]
    assert all(0 <= share[key] <= 1 for key in ("median", "at_peak"))
    assert share["peak_hz"] == pytest.approx(noise.freqs_hz[noise.residual.max(axis=0).argmax()])
    order = Tightness.load(demo / "uncertainty" / name / "order")
    assert metrics["uncertainty"][name]["order_db"]["overbound"] == pytest.approx(order.overbound_db)
    assert np.all(order.proven_db <= order.overbound_db + 1e-9)


@pytest.mark.parametrize("name", KINDS)
def test_resampled_models_surround_the_stored_ones(demo, name):
    config, store = load_run(demo)
    models = ModelSet.load(demo / "models" / name)
    units = list(reversed(models.unit_ids[1:]))
    rows = [models.index(u) for u in units]
    with open_executor(1, None) as executor:
        samples = resampled_models(Context(config, store, executor, Silent()), name, units)
    assert samples.unit_ids == tuple(units)
    np.testing.assert_allclose(samples.estimate.A, models.A[rows], atol=1e-9)
    np.testing.assert_allclose(samples.estimate.B, models.B[rows], atol=1e-9)
    middle, spread = samples.samples.A.mean(axis=1), samples.samples.A.std(axis=1)
    assert np.median(np.abs(middle - samples.estimate.A) / spread) < 0.5  # three episodes: single entries may be skewed


def test_units_are_kept_beside_their_weights(demo, metrics):
    for name in KINDS[:2]:
        kept = UnitResiduals.load(demo / "uncertainty" / name / "units")
        assert len(kept.unit_ids) == 5
        assert kept.ratio.max() <= 1
        assert np.all(kept.entry_weights >= kept.largest * (1 - 1e-9))
    top = max(metrics["outliers"], key=lambda row: (row["outlier"], row["score"]))
    suffix = "" if top["condition"] == "noload" else f"@{top['condition']}"
    for name in KINDS[2:]:
        others = UnitResiduals.load(demo / "outliers" / f"{name}{suffix}" / "others")
        assert others.outside[0] == top["unit"]
        assert others.ratio[others.rows(inside=True)].max() <= 1 + 1e-9


def test_scores_come_with_their_range(metrics):
    for row in metrics["outliers"]:
        assert row["lowest_db"] <= row["highest_db"]
        assert 0 <= row["agreement"] <= 1
        assert row["freq_hz"] > 0
        assert len(row["entry"]) == 2
