"""Systems to and from python-control: numbers, batches, names, and what cannot be taken over."""

from __future__ import annotations

import dataclasses

import control
import numpy as np
import pytest
from random_models import random_models

from kros.core import DimensionError, StateSpace
from kros.identify import ModelSet
from kros.interop import from_control, to_control
from kros.uncertainty import quantify

DT = 0.01
FREQS_HZ = np.array([0.1, 3.0, 40.0])


def random_batch(*batch: int) -> StateSpace:
    rng = np.random.default_rng(1)
    A = 0.3 * rng.normal(size=(*batch, 3, 3))
    return StateSpace(
        A, rng.normal(size=(*batch, 3, 2)), rng.normal(size=(*batch, 4, 3)), rng.normal(size=(*batch, 4, 2)), DT
    )


def models(n_units: int = 3) -> ModelSet:
    formula, scale = "sin(0.5*position + phase)", np.array([1.0, 2.0, 1.0])
    return random_models([[0.0], [1.0], [0.3]], 0.01, formula, n_units, output_scale=scale)


def test_a_system_keeps_its_response_both_ways() -> None:
    system = random_batch()
    there = to_control(system, name="drive", states=["a", "b", "c"], inputs=["u", "v"], outputs=["p", "q", "r", "s"])
    response = there.frequency_response(2 * np.pi * FREQS_HZ).frdata
    assert np.allclose(np.moveaxis(response, -1, 0), system.frequency_response(FREQS_HZ), rtol=1e-12, atol=0)
    assert (there.name, there.dt) == ("drive", DT)
    assert (there.state_labels, there.input_labels) == (["a", "b", "c"], ["u", "v"])
    assert there.output_labels == ["p", "q", "r", "s"]
    back = from_control(there)
    assert all(np.array_equal(getattr(back, name), getattr(system, name)) for name in "ABCD")
    assert back.dt == DT


def test_continuous_systems_go_both_ways() -> None:
    continuous = to_control(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]], 0.0))
    assert continuous.dt == from_control(continuous).dt == 0
    assert from_control(control.sample_system(continuous, DT)).A[0, 0] == pytest.approx(np.exp(-DT))


@pytest.mark.parametrize("dt", [None, True])
def test_an_unknown_sampling_period_is_refused(dt: bool | None) -> None:
    with pytest.raises(DimensionError, match=f"not known .dt = {dt}"):
        from_control(control.StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], dt))


def test_a_transfer_function_is_realised_and_responses_are_refused() -> None:
    system = from_control(control.tf([1.0], [1.0, -0.5], DT))
    assert system.frequency_response([0.0]).item() == pytest.approx(2.0)
    match = r"needs a control\.StateSpace or control\.TransferFunction, found FrequencyResponseData"
    with pytest.raises(DimensionError, match=match):
        from_control(control.frd(control.tf([1.0], [1.0, -0.5], DT), [1.0]))


@pytest.mark.parametrize("names", [["a", "b"], ["a", "a", "b"], "abc"])
def test_wrong_names_are_refused(names: list[str] | str) -> None:
    with pytest.raises(DimensionError, match="3 states need as many different names"):
        to_control(random_batch(), states=names)


def test_names_have_no_dots() -> None:
    names = ["position", "velocity", "sin(0.5*position + phase)"]
    system = to_control(models().systems(["unit.1"])[0], name="unit.1", states=names, inputs=["target"], outputs=names)
    assert (system.name, system.input_labels) == ("unit·1", ["target"])
    assert system.state_labels == system.output_labels == [*names[:2], "sin(0·5*position + phase)"]


def test_weights_cover_the_residuals_in_python_control_too() -> None:
    population = models()
    model = quantify(population, form="additive", freqs_hz=np.geomspace(0.1, 45.0, 20))
    scaled, weights = to_control(model.scaled_nominal()), map(to_control, (model.weight.left, model.weight.right))
    left, right = (np.moveaxis(w.frequency_response(2 * np.pi * FREQS_HZ).frdata, -1, 0) for w in weights)
    for unit in population.unit_ids:
        other = dataclasses.replace(model, nominal_system=population.systems([unit])[0]).scaled_nominal()
        difference = to_control(other) - scaled
        E = np.moveaxis(difference.frequency_response(2 * np.pi * FREQS_HZ).frdata, -1, 0)
        covered = np.linalg.solve(left, E) @ np.linalg.inv(right)
        assert np.linalg.norm(covered, 2, axis=(-2, -1)).max() <= 1 + 1e-6
