"""Models: draws of the bootstrap, a bounded search, free runs, and models on disk."""

from __future__ import annotations

import numpy as np
import pytest
from random_models import random_models

from kros.core import DataError, DimensionError
from kros.identify import ModelSet, free_run
from kros.identify.edmd import bootstrap_edmd, episode_weights
from kros.identify.refine import GaussNewton
from kros.lifting import Lifting


@pytest.mark.parametrize(("episodes", "draws"), [([3, 1], 10), ([3, 3], 1), ([], 10)])
def test_too_little_to_draw_from_is_refused(episodes: list[int], draws: int) -> None:
    with pytest.raises(DataError, match="needs two episodes of every unit"):
        episode_weights(episodes, draws, 0)


def test_a_unit_with_fewer_episodes_is_resampled_among_its_own() -> None:
    R = np.linalg.qr(np.random.default_rng(0).normal(size=(1, 3, 30, 5)), mode="r")
    padded = np.concatenate([R, np.zeros((1, 2, 5, 5))], axis=1)
    weights = episode_weights([3], 6, 0)
    wide = np.concatenate([weights, np.zeros((1, 6, 2))], axis=2)
    own, found = bootstrap_edmd(R, 2, 0.0, weights), bootstrap_edmd(padded, 2, 0.0, wide)
    np.testing.assert_allclose(found.samples.A, own.samples.A, rtol=1e-9)


def test_search_stays_within_the_constraint_and_finds_both_minima() -> None:
    """min (v - t)^2 for t = 1 and 5, with v <= 2."""
    target = np.array([1.0, 5.0])

    def evaluate(V: np.ndarray) -> np.ndarray:
        rest = target - V[:, 0, 0]
        J = np.stack([np.ones(2), rest], axis=1)
        return J[:, :, None] * J[:, None, :]

    search = GaussNewton(iterations=60, least_gain=1e-12)
    solution = search.minimise(evaluate, lambda V: V[:, 0, 0] <= 2.0, np.zeros((2, 1, 1)))
    assert solution.V[0, 0, 0] == pytest.approx(1.0, abs=1e-6)
    assert 1.5 < solution.V[1, 0, 0] <= 2.0


def test_sizes_that_do_not_fit_are_named() -> None:
    lifting = Lifting(("position", "velocity"), ("sin(5*position + phase)",), ("phase",))
    with pytest.raises(DimensionError, match="do not fit a lifting of 2 states to 3"):
        free_run(np.eye(2), np.ones((2, 1)), lifting, {"phase": 0.0}, np.zeros((1, 2)), np.zeros((1, 5, 1)))


def test_models_survive_the_disk_and_damaged_ones_are_refused(tmp_path) -> None:
    others = {"parameters": {"phase": np.arange(3.0)}, "alpha": 90.0, "status": ("ok",) * 3}
    formula, scale = "sin(5*position + phase)", np.array([1.0, 2.0, 1.0])
    population = random_models([[0.0], [1.0], [0.3]], 0.01, formula, 3, output_scale=scale, **others)
    population.save(tmp_path)
    again = ModelSet.load(tmp_path)
    for name in ("A", "B", "output_scale", "input_scale"):
        np.testing.assert_array_equal(getattr(again, name), getattr(population, name))
    for name in ("lifting", "channels", "unit_ids", "alpha", "status", "measured"):
        assert getattr(again, name) == getattr(population, name)
    np.testing.assert_array_equal(again.parameters["phase"], population.parameters["phase"])
    (tmp_path / "model.json").write_text('{"schema": 99, "kind": "model"}')
    with pytest.raises(DataError, match=r"found \(99, 'model'\)"):
        ModelSet.load(tmp_path)
