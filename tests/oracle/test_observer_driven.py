"""The memory of an observer along recordings, against loops written out, exact error responses, and machines the observer does not know."""

import numpy as np
import pytest
from adversary import attack, attack_running
from batches import batch_of

from kros.core.errors import DimensionError
from kros.lifting import Lifting
from kros.observer import PastMoments, ReliftScales, relift_certificate
from kros.observer.certificate.report import relift_report
from kros.observer.predictor.build import embedded
from kros.observer.predictor.driven import driven_coordinates, with_internal
from kros.observer.residual.one_step import one_step_residual
from kros.synthesis.residual_shaped.shaping_filter import Basis

DT, SIZES, UNITS = 0.01, (1.0, 0.5), list("aabbcc")


def machine(n_samples=1500, seed=0, gain=0.8, cubic=0.0):
    """A position loop whose controller has an integrator; the hidden state is its command. `gain` and `cubic` make another machine of it."""
    rng = np.random.default_rng(seed)
    target = np.cumsum(0.01 * rng.normal(size=(n_samples, 6)), axis=0)
    phase = rng.uniform(-3, 3, 6)
    x, integral = np.zeros((n_samples, 6, 2)), np.zeros(6)
    x[0, :, 0] = target[0] = 0.1 * rng.normal(size=6)
    for k in range(n_samples - 1):
        p, c = x[k].T
        error = target[k] - p
        integral = 0.98 * integral + error
        wave = np.sin(5 * p + phase)
        x[k + 1, :, 0] = p + 0.1 * c - cubic * c**3 + 0.01 * wave + 0.002 * rng.normal(size=6)
        x[k + 1, :, 1] = 0.5 * c + gain * error + 0.02 * integral + 0.05 * wave
    return x, target[..., None], {"phase": phase}


def remembering(functions=("sin(5*p + phase)", "cos(5*p + phase)")):
    x, u, phase = machine()
    lifting = Lifting(("p", "c"), functions, ("phase",) if functions else ())
    values = phase if functions else None
    batch = batch_of(x, u, DT, values, units=UNITS)
    past = PastMoments.of(lifting, (0,), batch, Basis(15))
    return embedded("o", past, past.model(4), ("target",), batch), x, u, values


@pytest.fixture(scope="module")
def made():
    return remembering()


def settled(made):
    observer, x, u, values = made
    return driven_coordinates(observer, batch_of(x, u, DT, values), SIZES)


def test_the_memory_is_what_the_observer_s_own_rows_make_of_the_recordings(made):
    observer, x, u, phase = made
    found, n = with_internal(observer, x[:40], u[:40], phase), 5
    m = observer.initial(x[0, :, :1], phase)[:, 2:]
    for k in range(39):
        np.testing.assert_allclose(found[k, :, 2:], m, rtol=1e-9, atol=1e-9)
        lifted = observer.lifting.lift(np.hstack([x[k], m]), phase)
        m = (lifted @ observer.A.T + u[k] @ observer.B.T)[:, 2:n]
    np.testing.assert_array_equal(found[..., :2], x[:40])
    residual = one_step_residual(observer.lifting, observer.A, observer.B, found, u[:40], phase)
    assert np.abs(residual[..., 2:]).max() < 1e-9 * np.abs(found).max()
    assert with_internal(observer, found, u[:40], phase) is found
    with pytest.raises(DimensionError, match="driven by the 2 states p, c, found 3"):
        with_internal(observer, found[..., :3], u[:40], phase)


def test_without_lifted_functions_the_bound_is_the_error():
    observer, x, u, _ = remembering(functions=())
    own = driven_coordinates(observer, batch_of(x, u, DT), SIZES)
    other, v, _ = machine(seed=2, gain=0.5, cubic=0.05)
    certificate = relift_certificate(
        own, scales=ReliftScales(np.array(SIZES), np.array([1e-3, 1e-2]), np.array([1e-4])).with_internal(3)
    )
    rows = relift_report(certificate, own, batch_of(other, v, DT))
    for row in rows:
        assert row.frozen == pytest.approx(row.error, rel=1e-8)
        assert row.error <= row.gain_bound


@pytest.mark.parametrize("unlike", [{}, {"gain": 0.5}, {"gain": 1.1, "cubic": 0.05}])
def test_no_error_exceeds_its_bound_on_machines_of_any_kind(made, unlike):
    own = settled(made)
    x, u, phase = machine(seed=3, **unlike)
    residual = one_step_residual(own.lifting, own.A, own.B, with_internal(own, x, u, phase), u, phase)[..., :2]
    scales = ReliftScales.typical(SIZES, residual, 1e-4).with_internal(3)
    certificate = relift_certificate(own, scales=scales)
    assert certificate.certified
    np.testing.assert_array_equal(certificate.system(own).C[2:], 0.0)
    for row in relift_report(certificate, own, batch_of(x, u, DT, phase)):
        assert row.holds
        assert row.error <= row.bound <= row.gain_bound


def test_nobody_exceeds_the_gain_and_it_is_nearly_attained(made):
    own, rng = settled(made), np.random.default_rng(0)
    certificate = relift_certificate(
        own, scales=ReliftScales(np.array(SIZES), np.array([1e-3, 1e-2]), np.array([1e-4])).with_internal(3)
    )
    found = attack(certificate, own)
    assert 0.5 < found.share <= 1
    inputs = rng.normal(size=(len(found.disturbance) + 1, 4, 1))
    share, steps = attack_running(
        certificate, own, found.disturbance, rng.normal(size=(4, 5)), inputs, {"phase": rng.uniform(-3, 3, 4)}
    )
    assert steps > 0
    assert share <= 1
