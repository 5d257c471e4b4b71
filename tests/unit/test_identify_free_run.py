"""Free run, models on disk, and the smallest parts around them."""

import numpy as np
import pytest

from kros.core.errors import DataError, DimensionError
from kros.data import Channel, Role
from kros.identify import ModelSet, free_run
from kros.lifting import Lifting

LIFTING = Lifting(("position", "velocity"), ("sin(5*position + phase)",), ("phase",))


def models(n_units=3, seed=0):
    rng = np.random.default_rng(seed)
    A = 0.5 * rng.normal(size=(n_units, 3, 3)) / 3
    channels = (
        Channel("position", Role.STATE, "rad", True),
        Channel("velocity", Role.STATE, "rad/s"),
        Channel("u", Role.INPUT),
    )
    return ModelSet(
        name="koopman_edmd",
        condition="noload",
        lifting=LIFTING,
        channels=channels,
        sample_period_s=0.01,
        unit_ids=tuple(f"{i:06d}" for i in range(n_units)),
        A=A,
        B=rng.normal(size=(n_units, 3, 1)),
        parameters={"phase": np.arange(n_units, dtype=float)},
        output_scale=np.ones(3),
        input_scale=np.ones(1),
        alpha=90.0,
        status=("ok",) * n_units,
    )


def test_sizes_that_do_not_fit_are_named():
    with pytest.raises(DimensionError, match="do not fit a lifting of 2 states to 3"):
        free_run(np.eye(2), np.ones((2, 1)), LIFTING, {"phase": 0.0}, np.zeros((1, 2)), np.zeros((1, 5, 1)))


def test_models_survive_the_disk(tmp_path):
    population = models()
    population.save(tmp_path)
    again = ModelSet.load(tmp_path)
    for name in ("A", "B", "output_scale", "input_scale"):
        np.testing.assert_array_equal(getattr(again, name), getattr(population, name))
    assert (again.lifting, again.channels, again.unit_ids, again.alpha, again.status) == (
        LIFTING,
        population.channels,
        population.unit_ids,
        90.0,
        population.status,
    )
    np.testing.assert_array_equal(again.parameters["phase"], population.parameters["phase"])
    assert again.measured == (0,)
    response = again.systems().frequency_response([1.0, 10.0])
    assert response.shape == (3, 2, 3, 1)


def test_a_damaged_model_is_refused(tmp_path):
    models().save(tmp_path)
    (tmp_path / "model.json").write_text('{"schema": 99, "kind": "model"}')
    with pytest.raises(DataError, match=r"found \(99, 'model'\)"):
        ModelSet.load(tmp_path)
