"""What a study makes of the certificate as it runs: operating boxes, facts, the section of the report."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from batches import batch_of

from kros.core.errors import DimensionError, SynthesisError
from kros.core.lti import gain
from kros.design.certificates import Running, certify
from kros.design.synthesize import choose_deployed, robust_of
from kros.lifting import Lifting
from kros.observer import Observer, ReliftScales, ReliftStatus, relift_certificate, signal_bound
from kros.synthesis import Injection


def observer(name: str, formula: str, slope: float) -> Observer:
    """x+ = 0.8 x + slope * formula + u, without a correction."""
    model = np.array([[0.8, slope], [0.0, 0.0]])
    parameters = ("phase",) if "phase" in formula else ()
    return Observer(
        name,
        Lifting(("x",), (formula,), parameters),
        model,
        np.array([[1.0], [0.0]]),
        (0,),
        ("u",),
        gain(np.zeros((2, 1)), 1.0),
        Injection.STATE,
        1.0,
    )


@pytest.fixture
def task() -> Any:
    lifting = Lifting(("x",), ("x**2",))
    models = SimpleNamespace(
        lifting=lifting,
        output_scale=np.array([2.0, 4.0]),
        recorded_inputs=("u",),
        input_scale=np.ones(1),
        parameters={"phase": np.array([0.1, 0.4])},
    )
    return SimpleNamespace(models=models)


def test_slopes_without_a_bound_get_an_operating_box(task: Any, caplog: pytest.LogCaptureFixture) -> None:
    scales = ReliftScales(np.ones(1), np.ones(1), np.ones(1))
    found = certify(observer("square", "x**2", 0.01), scales, task)
    assert found.box["x"] == (-3.0, 3.0)
    assert found.gain == pytest.approx(1 / (1 - 0.8 - 0.06), rel=5e-3)
    assert any("x in [-3, 3]" in text for text in found.assumptions)
    steep = certify(observer("steep", "x**2", 0.1), scales, task)
    assert steep.status is ReliftStatus.UNSTABLE
    assert "steep: no certificate covers it as it runs" in caplog.text


def test_global_slopes_need_no_box_and_no_phase(task: Any) -> None:
    found = certify(observer("sine", "sin(x + phase)", 0.1), ReliftScales(np.ones(1), np.ones(1), np.ones(1)), task)
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


def test_wrong_scales_are_refused() -> None:
    with pytest.raises(DimensionError, match="needs 1 errors"):
        relift_certificate(observer("sine", "sin(x)", 0.1), scales=ReliftScales(np.ones(2), np.ones(1), np.ones(1)))
    with pytest.raises(DimensionError, match="finite sizes above zero"):
        ReliftScales(np.zeros(1), np.ones(1), np.ones(1))


def test_deployed_is_the_most_accurate_observer_that_is_certified_as_it_runs() -> None:
    good, bad = observer("koopman/open_loop", "sin(x)", 0.1), observer("koopman/worst_case_h2", "sin(x)", 0.5)
    certificate, refused = relift_certificate(good), relift_certificate(bad)
    assert certificate.certified
    assert not refused.certified
    running = [
        Running("koopman/open_loop", certificate, 3.0, 5.0),
        Running("koopman/kalman_tuned", certificate, 2.0, 5.0),
        Running("koopman/residual_h2", certificate, 1.0, float("inf")),
        Running("linear/residual_h2", certificate, float("inf"), 5.0),
        Running("koopman/worst_case_h2", refused, 0.5, 5.0),
    ]
    made = [r.name for r in running]
    assert choose_deployed(None, made, running) == "koopman/kalman_tuned"
    assert choose_deployed(None, made, running[2:3]) == "koopman/residual_h2"
    unbounded = replace(
        running[1], signals=signal_bound(refused, bad, batch_of(np.zeros((50, 1, 1)), np.zeros((50, 1, 1)), 1.0))
    )
    assert choose_deployed(None, made, [running[0], unbounded]) == "koopman/open_loop"
    assert choose_deployed(None, made, [unbounded]) == "koopman/kalman_tuned"
    assert choose_deployed("koopman/open_loop", made, running) == "koopman/open_loop"
    assert choose_deployed(None, made, running[4:]) == "koopman/worst_case_h2"
    with pytest.raises(SynthesisError, match="there is no such observer"):
        choose_deployed("ours", made, running)
    facts: dict[str, Any] = {name: {"worst_case_h2": None} for name in made}
    assert robust_of(running, facts) is running
    facts["koopman/open_loop"]["worst_case_h2"] = 0.3
    assert choose_deployed(None, made, robust_of(running, facts)) == "koopman/open_loop"
