"""Edges of the scores: short, constant and diverging recordings, weights, sizes."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from kros.core import DataError, DimensionError
from kros.identify import KoopmanMatrices, score
from kros.identify import scores as scores_module
from kros.identify.scores import weighted_mean
from kros.lifting import Lifting

LIFTING = Lifting(("a", "b"))
MODEL = KoopmanMatrices(np.array([[0.5, 0.0], [0.1, 0.9]]), np.array([[1.0], [0.0]]))


def episode(n_samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n_samples, 2)), rng.normal(size=(n_samples, 1))


def test_short_episodes_are_skipped_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    found = score(MODEL, LIFTING, {}, [episode(10), episode(30, 1)], (1, 10))
    assert found.counts.tolist() == [[9, 0], [29, 20]]
    assert np.isnan(found.rms[0, 1]).all()
    np.testing.assert_array_equal(found.mean("rms")[1], found.rms[1, 1])
    np.testing.assert_array_equal(found.pooled().rms[0, 1], found.rms[1, 1])
    assert "episode 0 of 2 has 10 samples, too few for horizon 10" in caplog.text


def test_a_horizon_longer_than_every_episode_is_an_error() -> None:
    with pytest.raises(DataError, match="horizon 40 needs episodes of 41 samples or more, the longest has 30"):
        score(MODEL, LIFTING, {}, [episode(30)], (1, 40))


@pytest.mark.parametrize("level", [0.0, 0.1, 1e6 / 3])
def test_a_constant_state_has_no_r2(level: float) -> None:
    x, u = episode(50)
    x[:, 1] = level
    found = score(MODEL, LIFTING, {}, [(x, u)], (1, None))
    assert np.isnan(found.r2[..., 1]).all()
    assert np.isfinite(found.r2[..., 0]).all()
    assert np.isnan(found.percent[..., 1]).all() == (level == 0)


def test_diverging_runs_score_infinity_without_warnings() -> None:
    found = score(KoopmanMatrices(1e9 * MODEL.A, MODEL.B), LIFTING, {}, [episode(60), episode(90, 1)], (1, None))
    assert np.isinf(found.percent[:, 1]).all()
    assert (found.r2[:, 1] == -np.inf).all()
    assert np.isfinite(found.percent[:, 0]).all()
    assert np.isinf(found.mean()[1]).all()
    unusable = score(KoopmanMatrices(np.nan * MODEL.A, MODEL.B), LIFTING, {}, [episode(60)], (1, None))
    assert np.isinf(unusable.rms).all()


def test_episodes_of_any_length_and_in_any_chunks_score_as_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes = [episode(n, n) for n in (40, 90, 13, 90)]
    models = KoopmanMatrices(MODEL.A * np.linspace(0.5, 1, 4)[:, None, None], np.tile(MODEL.B, (4, 1, 1)))
    together = score(models, LIFTING, {}, episodes, (1, 7, None), stride=2)
    monkeypatch.setattr(scores_module, "_AT_ONCE", 600)
    chunked = score(models, LIFTING, {}, episodes, (1, 7, None), stride=2)
    for i, own in enumerate(episodes):
        alone = score(KoopmanMatrices(models.A[i], models.B[i]), LIFTING, {}, [own], (1, 7, None), stride=2)
        for found in (together, chunked):
            np.testing.assert_allclose(found.rms[i], alone.rms[0], rtol=1e-12)
            np.testing.assert_allclose(found.r2[i], alone.r2[0], rtol=1e-12)


def test_weights_leave_out_states_of_weight_zero() -> None:
    x, u = episode(50)
    x[:, 1] = 0.0
    found = score(MODEL, LIFTING, {}, [(x, u)], (1,))
    assert found.mean("percent", [2.0, 0.0])[0] == found.percent[0, 0, 0]
    np.testing.assert_allclose(weighted_mean(np.array([[1.0, 3.0]]), [3, 1]), [1.5])
    with pytest.raises(DimensionError, match="as many weights"):
        weighted_mean(np.ones((1, 2)), [0.0, 0.0])
    with pytest.raises(DimensionError, match="percent, rms or r2"):
        found.mean("counts")


@pytest.mark.parametrize("wrong", [{"horizons": (0,)}, {"horizons": ()}, {"stride": 0}])
def test_impossible_requests_are_refused(wrong: dict) -> None:
    with pytest.raises(DimensionError, match="at least one sample"):
        score(MODEL, LIFTING, {}, [episode(20)], **wrong)


def test_models_that_do_not_fit_are_refused() -> None:
    with pytest.raises(DimensionError, match="one for each of 1 episodes"):
        score(KoopmanMatrices(np.zeros((2, 2, 2)), np.zeros((2, 2, 1))), LIFTING, {}, [episode(20)])
