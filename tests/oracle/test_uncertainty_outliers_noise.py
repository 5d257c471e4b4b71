"""What is said beside a score: lags with estimation errors that are known by construction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.uncertainty import OutlierModel, score_outliers
from kros.uncertainty.outliers.score import Status

FREQS = np.geomspace(0.1, 100.0, 40)
SPREAD, NOISE = 0.02, 0.01
SHAPE = (len(FREQS), 2, 1)


def plants(rng: np.random.Generator, count: int, spread: float = SPREAD) -> np.ndarray:
    """First-order lags whose gains and corners vary."""
    gain, corner = np.exp(spread * rng.normal(size=(2, count, 1, 2, 1)))
    return np.array([[1.0], [0.5]]) * gain / (1 + 1j * FREQS[:, None, None] / (10 * corner))


def errors(rng: np.random.Generator, size: float, *count: int) -> np.ndarray:
    """Estimation errors that change over frequency as responses of resampled models do: sums of a few lags."""
    lags = 1 / (1 + 1j * FREQS[:, None, None] / np.array([0.5, 5.0, 50.0])[:, None, None, None])
    return np.asarray(
        size * np.einsum("...kpm,kfpm->...fpm", rng.normal(size=(*count, 3, 2, 1)), np.broadcast_to(lags, (3, *SHAPE)))
    )


def batch(rng: np.random.Generator, count: int = 12) -> OutlierModel:
    """Score good units."""
    return score_outliers(plants(rng, count) + errors(rng, NOISE, count), FREQS)


def test_the_change_beside_a_score_is_what_would_have_been_flagged() -> None:
    """A unit in the middle of the others is flagged with an output changed by clearly more, with none by clearly less."""
    rng = np.random.default_rng(6)
    model = batch(rng, 16)
    middle = np.median(model.responses.real, axis=0) + 1j * np.median(model.responses.imag, axis=0)
    middle = middle * model.output_scale[:, None] / model.input_scale
    score = model.score("ok", middle)
    assert score.status is Status.OK
    for factor, expected in ((0.5, False), (3.0, True)):
        for i, percent in enumerate(score.detectable_percent):
            changed = middle.copy()
            changed[:, i] *= 1 + factor * percent / 100
            assert model.score("changed", changed).outlier is expected


def test_scores_of_few_units_survive_saving(tmp_path: Path) -> None:
    model = batch(np.random.default_rng(7), 4)
    model.save(tmp_path / "four")
    assert OutlierModel.load(tmp_path / "four").scores == model.scores
    three = batch(np.random.default_rng(8), 3)
    assert three.scores[0].detectable_percent == ()
    three.save(tmp_path / "three")
    assert OutlierModel.load(tmp_path / "three").score("new", three.responses[0]).status is Status.CANNOT_TELL


def test_a_unit_is_not_held_against_itself() -> None:
    rng = np.random.default_rng(9)
    G = plants(rng, 12)
    G[0] *= 1.05
    whole, others = score_outliers(G, FREQS), score_outliers(G[1:], FREQS)
    itself = whole.score("0", G[0], without={"0"})
    assert itself.excess_db == pytest.approx(others.score("0", G[0]).excess_db, abs=1e-6)
    assert whole.score("0", G[0]).excess_db < itself.excess_db
    with pytest.raises(DataError, match="two are needed"):
        whole.score("0", G[0], without=whole.unit_ids[1:])


def test_a_unit_beyond_the_others_by_what_motions_explain_is_left_open() -> None:
    """Halves of the episodes that differ by as much as the unit does, by far less, and not at all."""
    rng = np.random.default_rng(10)
    G = plants(rng, 12)
    model = score_outliers(G, FREQS)
    bad = 1.5 * G[0]
    assert model.score("bad", bad).status is Status.OUTLIER
    for difference, expected in ((1.0, Status.OTHER_MOTIONS), (1e-3, Status.OUTLIER), (0.0, Status.OUTLIER)):
        motion = model.motion_levels(G, G * (1 + difference))
        assert motion.shape == FREQS.shape
        assert model.score("bad", bad, motion_db=motion).status is expected
        assert model.score("good", G[3], without={"3"}, motion_db=motion).status is Status.OK
