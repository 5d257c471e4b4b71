"""Sets of models from python-control and from bare responses: the weights bound the residuals of the models as python-control evaluates them."""

from __future__ import annotations

import numpy as np
import pytest

control = pytest.importorskip("control")

from kros.core.errors import ConfigError, DataError, DimensionError  # noqa: E402
from kros.interop import from_control, uncertainty_to_control  # noqa: E402
from kros.uncertainty import quantify  # noqa: E402
from kros.uncertainty.weights.bilinear import BilinearAxis  # noqa: E402

FREQS = np.geomspace(1e-3, 10.0, 80)


def quantified(models, *args, **options):
    """Quantify systems or response data of python-control, and return weights of python-control."""
    named = models.items() if isinstance(models, dict) else enumerate(models)
    read = {str(k): m if isinstance(m, control.FRD) else from_control(m) for k, m in named}
    return uncertainty_to_control(quantify(read, *args, **options))


def motors(count: int, seed: int = 0) -> list:
    """Continuous position and velocity of second-order motors from torque, parameters spread by ten percent."""
    rng = np.random.default_rng(seed)
    spread = np.exp(0.1 * rng.normal(size=(count, 3)))
    return [
        control.ss([[0, 1], [-4 * k[0], -1.5 * k[1]]], [[0], [3 * k[2]]], np.eye(2), np.zeros((2, 1))) for k in spread
    ]


def response(system, freqs: np.ndarray) -> np.ndarray:
    """As python-control evaluates it, one frequency at a time."""
    points = 2j * np.pi * freqs if system.dt == 0 else np.exp(2j * np.pi * freqs * system.dt)
    return np.array([np.asarray(system(s, squeeze=False)).reshape(system.noutputs, system.ninputs) for s in points])


def largest_ratio(found, models: list, define, freqs: np.ndarray) -> float:
    left, right, g = response(found.left, freqs), response(found.right, freqs), response(found.nominal, freqs)
    worst = 0.0
    for model in models:
        E = define(g, response(model, freqs))
        worst = max(
            worst, float(np.linalg.norm(np.linalg.solve(left, E) @ np.linalg.inv(right), 2, axis=(-2, -1)).max())
        )
    return worst


@pytest.mark.parametrize("form", ["additive", "inverse_output_multiplicative"])
def test_continuous_weights_bound_continuous_models(form: str) -> None:
    models = motors(4)
    found = quantified(models, form, FREQS, tolerance_db=2.0)
    assert found.left.dt == found.right.dt == found.nominal.dt == 0
    assert (found.left.poles().real < 0).all()
    assert (found.left.zeros().real < 0).all()
    define = (lambda g, h: h - g) if form == "additive" else (lambda g, h: (h - g) @ np.linalg.pinv(h))
    # Both forms fall or settle beyond the grid, so that the held residual bounds them there as well.
    assert largest_ratio(found, models, define, np.concatenate([[1e-7], np.geomspace(1e-4, 3e3, 301)])) <= 1 + 1e-4
    assert "imaginary axis up to 100 Hz" in found.certificate


def test_discrete_models_with_names_keep_their_time_and_the_nominal_asked_for() -> None:
    poles = {"a": 0.80, "b": 0.90}
    models = {name: control.ss([[p]], [[1 - p]], [[1.0]], [[0.0]], 0.01) for name, p in poles.items()}
    middle = control.tf([0.14], [1, -0.86], 0.01)
    found = quantified(models, "additive", np.geomspace(0.01, 50, 60), nominal=from_control(middle))
    assert (found.model.nominal_id, found.model.nominal, found.left.dt) == ("pooled", -1, 0.01)
    assert largest_ratio(found, list(models.values()), lambda g, h: h - g, np.linspace(0.05, 50, 97)) <= 1 + 1e-5
    named = quantified(models, "additive", np.geomspace(0.01, 50, 30), nominal="b", max_order=1)
    assert named.model.nominal_id == "b"


def test_transfer_functions_of_different_orders_equal_their_state_spaces() -> None:
    first = control.tf([[[1.0], [0.0]], [[1.0], [2.0]]], [[[1, 1], [1]], [[1, 3, 2], [1]]])
    second = control.tf([[[1.1], [0.0]], [[0.9], [2.2]]], [[[1, 1.1], [1]], [[1, 2.0], [1]]])
    found = quantified([first, second], "additive", FREQS, nominal=0, max_order=2, tolerance_db=6.0)
    s = 2j * np.pi * 0.7
    expected = np.array([[1 / (s + 1), 0], [1 / (s**2 + 3 * s + 2), 2.0]])
    np.testing.assert_allclose(found.nominal(s), expected, rtol=1e-10, atol=1e-14)
    gap = np.array([[1.1 / (s + 1.1), 0], [0.9 / (s + 2), 2.2]]) - expected
    assert np.linalg.norm(np.linalg.solve(found.left(s), gap) @ np.linalg.inv(found.right(s)), 2) <= 1 + 1e-6


def test_responses_are_bounded_where_they_are_known_and_the_certificate_says_so() -> None:
    models = motors(4, 1)
    found = quantified([control.frd(m, 2 * np.pi * FREQS) for m in models], "output_multiplicative")
    assert isinstance(found.nominal, control.FRD)
    assert isinstance(found.scaled_nominal, control.FRD)
    left, right = response(found.left, FREQS), response(found.right, FREQS)
    g = response(models[found.model.nominal], FREQS)
    for model in models:
        E = (response(model, FREQS) - g) @ np.linalg.pinv(g)
        assert np.linalg.norm(np.linalg.solve(left, E) @ np.linalg.inv(right), 2, axis=(-2, -1)).max() <= 1 + 1e-9
    assert "not between" in found.certificate
    assert found.remainder_left is None or found.model.misfit.max() > 1e-9


def test_bilinear_axis_maps_responses_exactly() -> None:
    from kros.core import StateSpace

    rng = np.random.default_rng(3)
    A = rng.normal(size=(4, 4))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    system = StateSpace(A, rng.normal(size=(4, 2)), rng.normal(size=(2, 4)), rng.normal(size=(2, 2)), 0.3)
    axis = BilinearAxis(0.3)
    freqs = np.geomspace(1e-4, 1e3, 50)
    np.testing.assert_allclose(
        axis.continuous(system).frequency_response(freqs), system.frequency_response(axis.discrete_hz(freqs)), rtol=1e-9
    )
    np.testing.assert_allclose(axis.discrete(axis.continuous(system)).A, system.A, rtol=1e-9)
    known = axis.continuous(StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.3))
    np.testing.assert_allclose(
        known.A, [[2 / 0.3 * (0.5 - 1) / (0.5 + 1)]]
    )  # s = (2 / T) (z - 1) / (z + 1) at the pole


def test_bad_input_is_refused() -> None:
    models = motors(3)
    data = [control.frd(m, 2 * np.pi * FREQS) for m in models]
    with pytest.raises(DataError, match="two units"):
        quantified(models[:1])
    with pytest.raises(DimensionError, match="needs a system"):
        quantified([models[0], data[0]])
    with pytest.raises(DimensionError, match="differ in"):
        quantified([models[0], control.sample_system(models[1], 0.1)])
    with pytest.raises(DataError, match="unstable"):
        quantified([control.tf([1], [1, 1]), control.tf([1], [1, -1])])
    with pytest.raises(ConfigError, match="drop freqs_hz"):
        quantified(data, "additive", FREQS)
    with pytest.raises(DimensionError, match="other frequencies"):
        quantified([data[0], control.frd(models[1], FREQS)])
    with pytest.raises(DataError, match="NaN or infinity at 1 Hz"):
        quantified([control.FRD(g, np.pi * np.array([1.0, 2.0])) for g in ([1.0, 2.0], [1.0, np.nan])], "additive")
    with pytest.raises(ConfigError, match="static"):
        quantified([control.ss([], [], [], [[k]], 0) for k in (1.0, 2.0)])
