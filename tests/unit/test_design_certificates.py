"""What a study makes of the certificate of the nonlinear observer: operating boxes, sizes, which one is deployed."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from batches import batch_of

from kros.core.errors import SynthesisError
from kros.core.lti import gain
from kros.design.certificates import certify_model, guards_of, loss_error_percent
from kros.design.synthesize import choose_deployed
from kros.design.task import Design
from kros.lifting import Lifting
from kros.observer import Observer, ReliftScales, ReliftStatus, Seen, relift_certificate
from kros.synthesis import Injection, Status, Synthesis


def observer(name: str, formula: str, slope: float) -> Observer:
    """x+ = 0.8 x + slope * formula + u, without a correction."""
    A, B = np.array([[0.8, slope], [0.0, 0.0]]), np.array([[1.0], [0.0]])
    lifting = Lifting(("x",), (formula,), ("phase",) if "phase" in formula else ())
    return Observer(name, lifting, A, B, (0,), ("u",), gain(np.zeros((2, 1)), 1.0), Injection.STATE, 1.0)


@pytest.fixture
def task() -> Any:
    lifting, phases = Lifting(("x",), ("x**2",)), {"phase": np.array([0.1, 0.4])}
    return SimpleNamespace(models=SimpleNamespace(lifting=lifting, recorded_inputs=("u",), parameters=phases))


def test_slopes_without_a_bound_get_an_operating_box(task: Any, caplog: pytest.LogCaptureFixture) -> None:
    scales = ReliftScales(np.ones(1), np.ones(1), np.ones(1))
    recorded = [batch_of(np.array([[[-2.0]], [[2.0]]]), np.array([[[4.0]], [[6.0]]]), 1.0)]
    found = certify_model(observer("square", "x**2", 0.01), scales, task, recorded)
    assert (found.box["x"], found.box["u"]) == ((-3.0, 3.0), (3.5, 6.5))  # around the recordings, not around zero
    assert found.gain == pytest.approx(1 / (1 - 0.8 - 0.06), rel=5e-3)
    assert any("x in [-3, 3]" in text for text in found.assumptions)
    steep = certify_model(observer("steep", "x**2", 0.1), scales, task, recorded)
    assert steep.status is ReliftStatus.UNSTABLE
    assert "steep: no certificate for the nonlinear observer" in caplog.text


def test_global_slopes_need_no_box_and_no_phase(task: Any) -> None:
    scales = ReliftScales(np.ones(1), np.ones(1), np.ones(1))
    found = certify_model(observer("sine", "sin(x + phase)", 0.1), scales, task, ())
    assert found.certified
    assert not found.box
    assert "any value of phase" in found.assumptions


def test_typical_scales_give_the_residual_of_a_population_unit_power() -> None:
    residual = np.array([[[3.0, 0.1], [-4.0, 0.1]], [[0.0, -0.1], [0.0, 0.1]]])  # unit, sample, state
    found = ReliftScales.typical([2.0, 5.0], residual, [0.3, 0.4, 0.5])
    np.testing.assert_allclose(found.residual, [np.sqrt(25 / 4 * 2), np.sqrt(0.01 * 2)])
    assert np.mean(np.sum((residual / found.residual) ** 2, axis=-1)) == pytest.approx(1)
    np.testing.assert_allclose(found.noise, np.sqrt(3) * np.array([0.3, 0.4, 0.5]))
    np.testing.assert_array_equal(found.error, [2.0, 5.0])


def test_no_pattern_of_losses_brings_an_estimate_beyond_twice_the_largest_value() -> None:
    """A model that grows without its correction, with estimates in training that stay near the recordings."""
    model = np.array([[1.0, 0.1], [0.2, 1.05]]), np.zeros((2, 1)), (0,), ("u",)
    K, seen = gain([[1.0], [2.0]], 0.1), Seen(np.ones(1), np.ones(1))
    corrected = Observer("o", Lifting(("x", "v")), *model, K, Injection.STATE, 0.1, seen=seen)
    t = 0.1 * np.arange(300)
    batch = batch_of(np.stack([np.sin(t), np.cos(t)], axis=-1)[:, None], np.zeros((300, 1, 1)), 0.1)
    (guard,) = guards_of([corrected], [batch])
    size, rng = np.abs(batch.states).max(axis=(0, 1)), np.random.default_rng(0)
    assert guard is not None
    assert (np.maximum(np.abs(guard.lower), np.abs(guard.upper)) <= 2 * size * (1 + 1e-12)).all()
    lost = rng.random((300, 20)) < np.linspace(0.1, 0.98, 20)
    y = np.where(lost[..., None], np.nan, np.tile(batch.states[..., :1], (1, 20, 1)))
    estimates = replace(corrected, guard=guard).run(y, np.zeros((300, 20, 1)))
    free = corrected.run(y, np.zeros((300, 20, 1)))
    worst = [np.abs(x - batch.states).max(axis=(0, 1)) / size for x in (estimates, free)]
    assert worst[0].max() <= 3 < worst[1].max()


def test_errors_with_lost_measurements_do_not_depend_on_the_order_of_units() -> None:
    count = 20
    rng, model = np.random.default_rng(count), (np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.0], [0.1]]))
    inputs = rng.normal(size=(200, count, 1)) * rng.uniform(0.5, 2.0, count)[:, None]
    states = np.zeros((200, count, 2))
    for k in range(199):
        states[k + 1] = 0.9 * states[k] @ model[0].T + inputs[k] @ model[1].T
    K = gain([[0.3], [0.2]], 1.0)
    observers = [Observer("o", Lifting(("x", "v")), *model, (0,), ("u",), K, Injection.STATE, 1.0)]
    batch, order = batch_of(states, inputs, 1.0), rng.permutation(count)
    errors = [loss_error_percent(observers, recorded) for recorded in (batch, batch.take(order.tolist()))]
    assert 0 < errors[0].item() < np.inf
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-9)


def test_deployed_is_the_most_accurate_observer_that_is_certified_as_it_runs() -> None:
    good, bad = observer("koopman/open_loop", "sin(x)", 0.1), observer("koopman/worst_case_h2", "sin(x)", 0.5)
    certificate, refused = relift_certificate(good), relift_certificate(bad)
    assert certificate.certified
    assert not refused.certified

    def design(name: str, proof: Any, hidden: float, blind: float = 5.0, **facts: Any) -> Design:
        facts |= {"hidden_error_percent": hidden, "loss_error_percent": blind}
        return Design(name, good, Synthesis("", good.controller, Status.OPTIMAL), facts, proof)

    designs = [
        design("koopman/open_loop", certificate, 3.0),
        design("koopman/kalman_tuned", certificate, 2.0),
        design("koopman/residual_h2", certificate, 1.0, float("inf")),
        design("linear/residual_h2", certificate, float("inf")),
        design("koopman/worst_case_h2", refused, 0.5),
    ]
    assert choose_deployed(designs) == "koopman/kalman_tuned"
    assert choose_deployed(designs[2:3]) == "koopman/residual_h2"
    unbounded = design("koopman/kalman_tuned", certificate, 2.0, set_certified=False)
    assert choose_deployed([designs[0], unbounded]) == "koopman/open_loop"
    assert choose_deployed([unbounded]) == "koopman/kalman_tuned"
    assert choose_deployed(designs[4:]) == "koopman/worst_case_h2"
    near = design("koopman/worst_case_h2", certificate, 2.01)
    assert choose_deployed([*designs[:3], near]) == "koopman/worst_case_h2"
    with pytest.raises(SynthesisError, match="No observer could be designed"):
        choose_deployed([])
