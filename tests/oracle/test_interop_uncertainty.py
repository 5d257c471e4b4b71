"""Sets of models from python-control and from bare responses: the weights bound the residuals of the models as python-control evaluates them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

control = pytest.importorskip("control")

from kros.core.errors import ConfigError, DataError, DimensionError  # noqa: E402
from kros.interop import from_control, to_control  # noqa: E402
from kros.uncertainty import quantify  # noqa: E402

FREQS, DT = np.geomspace(1e-3, 10.0, 80), 0.05


def quantified(models, *args, **options):
    """Quantify systems or response data of python-control, and return the model with weights of python-control."""
    named = models.items() if isinstance(models, dict) else enumerate(models)
    read = {str(k): m if isinstance(m, control.FRD) else from_control(m) for k, m in named}
    model = quantify(read, *args, **options)
    found = SimpleNamespace(model=model, left=to_control(model.weight.left), right=to_control(model.weight.right))
    found.nominal = to_control(model.nominal_system) if hasattr(model, "nominal_system") else None
    return found


def motors(count: int, seed: int = 0) -> list:
    """Sampled position and velocity of second-order motors from torque, parameters spread by ten percent."""
    rng = np.random.default_rng(seed)
    spread = np.exp(0.1 * rng.normal(size=(count, 3)))
    return [
        control.ss([[0, 1], [-4 * k[0], -1.5 * k[1]]], [[0], [3 * k[2]]], np.eye(2), np.zeros((2, 1))).sample(DT)
        for k in spread
    ]


def response(system, freqs: np.ndarray) -> np.ndarray:
    """As python-control evaluates it, one frequency at a time."""
    points = np.exp(2j * np.pi * freqs * system.dt)
    return np.array([np.asarray(system(s, squeeze=False)).reshape(system.noutputs, system.ninputs) for s in points])


def test_transfer_functions_of_different_orders_equal_their_state_spaces() -> None:
    first = control.tf([[[0.2], [0.0]], [[0.1], [2.0]]], [[[1, -0.8], [1]], [[1, -1.3, 0.4], [1]]], DT)
    second = control.tf([[[0.22], [0.0]], [[0.12], [2.2]]], [[[1, -0.78], [1]], [[1, -0.7], [1]]], DT)
    found = quantified([first, second], "additive", FREQS, nominal=0, max_order=2, tolerance_db=6.0)
    z = np.exp(2j * np.pi * 0.7 * DT)
    expected = np.array([[0.2 / (z - 0.8), 0], [0.1 / (z**2 - 1.3 * z + 0.4), 2.0]])
    np.testing.assert_allclose(found.nominal(z), expected, rtol=1e-10, atol=1e-14)
    gap = np.array([[0.22 / (z - 0.78), 0], [0.12 / (z - 0.7), 2.2]]) - expected
    assert np.linalg.norm(np.linalg.solve(found.left(z), gap) @ np.linalg.inv(found.right(z)), 2) <= 1 + 1e-6


def test_responses_are_bounded_where_they_are_known_and_the_certificate_says_so() -> None:
    models = motors(4, 1)
    found = quantified([control.frd(m, 2 * np.pi * FREQS) for m in models], "output_multiplicative")
    left, right = response(found.left, FREQS), response(found.right, FREQS)
    g = response(models[found.model.nominal], FREQS)
    assert found.left.dt == DT
    for model in models:
        E = (response(model, FREQS) - g) @ np.linalg.pinv(g)
        assert np.linalg.norm(np.linalg.solve(left, E) @ np.linalg.inv(right), 2, axis=(-2, -1)).max() <= 1 + 1e-9
    assert "not between" in found.model.certificate
    assert found.model.remainder is None or found.model.misfit.max() > 1e-9


def test_bad_input_is_refused() -> None:
    models = motors(3)
    data = [control.frd(m, 2 * np.pi * FREQS) for m in models]
    with pytest.raises(DimensionError, match="needs a system"):
        quantified([models[0], data[0]])
    with pytest.raises(ConfigError, match="drop freqs_hz"):
        quantified(data, "additive", FREQS)
    with pytest.raises(DimensionError, match="other frequencies"):
        quantified([data[0], control.frd(models[1], FREQS)])
    with pytest.raises(DataError, match="NaN or infinity at"):
        quantified([control.FRD(g, np.pi * np.array([1.0, 2.0]), DT) for g in ([1.0, 2.0], [1.0, np.nan])], "additive")
    with pytest.raises(ConfigError, match="sample_system"):
        quantified([control.tf([1], [1, 1]), control.tf([1], [1, 2])])
    with pytest.raises(ConfigError, match="sample_period_s"):
        quantified([control.FRD(g, np.pi * np.array([1.0, 2.0]), 0) for g in ([1.0, 2.0], [1.0, 3.0])], "additive")
