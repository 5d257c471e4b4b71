"""Outlier scores: the planted unit on top, nothing flagged without reason, and the same answer in any order and units of measure."""

from __future__ import annotations

import numpy as np
import pytest
from drives import drives

from kros.core.errors import ConfigError, DataError, DimensionError
from kros.uncertainty import score_outliers

FREQS = np.geomspace(5e-3, 500.0, 150)


def responses(n_units: int, seed: int, outlier: bool = False) -> np.ndarray:
    return drives(n_units, seed, outlier).frequency_response(FREQS)


def test_flagged_units_are_left_out_of_the_model() -> None:
    model = score_outliers(responses(13, 0, outlier=True), FREQS, unit_ids=tuple("abcdefghijklm"))
    flagged = {s.unit for s in model.scores if s.outlier}
    assert "m" in flagged
    assert set(model.unit_ids) == set("abcdefghijklm") - flagged
    assert model.extrapolated
    assert 5e-3 <= model.scores[12].freq_hz <= 500.0
    assert model.scores[12].score_db > model.threshold_db


def test_order_of_units_and_units_of_measure_do_not_matter() -> None:
    G = responses(8, 3, outlier=True)
    plain = score_outliers(G, FREQS)
    order = np.random.default_rng(0).permutation(8)
    shuffled = score_outliers(G[order], FREQS)
    out, into = np.array([10.0, 1e-3, 7.0]), np.array([100.0, 0.2])
    scaled = score_outliers(G * out[:, None] / into, FREQS)
    reference = np.array([s.score_db for s in plain.scores])
    np.testing.assert_allclose([s.score_db for s in shuffled.scores], reference[order], atol=1e-9)
    np.testing.assert_allclose([s.score_db for s in scaled.scores], reference, atol=1e-6)


def test_identical_units_score_zero() -> None:
    G = np.repeat(responses(1, 6), 5, axis=0)
    for alike in (G, G * (1 + 1e-14 * np.arange(5.0)[:, None, None, None])):
        model = score_outliers(alike, FREQS)
        assert [(s.score_db, s.outlier) for s in model.scores] == [(0.0, False)] * 5


def test_one_unit_beside_identical_ones_is_flagged() -> None:
    G = np.repeat(responses(1, 6), 8, axis=0)
    G[4] *= 1.01
    model = score_outliers(G, FREQS)
    assert [s.outlier for s in model.scores] == [False] * 4 + [True] + [False] * 3
    assert np.isfinite(model.scores[4].score_db)


def test_bad_input_is_refused() -> None:
    G = responses(4, 7)
    broken = G.copy()
    broken[2, 10, 1, 0] = np.nan
    for given, options, message in (
        (G[:2], {}, "3 units"),
        (G[:, :-1], {}, "as many freqs_hz"),
        (G, {"false_alarm_rate": 2.0}, "rate"),
        (G[0], {}, "unit, frequency"),
        ([G[0], G[1], G[2, :, :2]], {"unit_ids": ("a", "b", "c")}, "'c' has the shape"),
        (G, {"form": "sideways"}, "form"),
        (broken, {}, "unit '2' has NaN"),
    ):
        with pytest.raises((ConfigError, DataError, DimensionError), match=message):
            score_outliers(given, FREQS, **options)
    model = score_outliers(G, FREQS)
    with pytest.raises(DataError, match="unit 'new'"):
        model.score("new", np.full_like(model.responses[0], np.nan))
