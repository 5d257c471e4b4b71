"""Gains in mean square for measurements that are lost at random, against exact second moments and simulated losses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adversary import attack

from kros.core.lti import gain
from kros.lifting import Lifting
from kros.observer import Observer, ReliftScales, Runtime, relift_certificate, run_observer
from kros.observer.certificate.mean_square import dropout_bound
from kros.synthesis import Injection

NO_NOISE = ReliftScales(np.ones(1), np.ones(1), np.zeros(1))


def scalar(a: float, correction: float) -> Observer:
    return Observer(
        "s",
        Lifting(("x",)),
        np.array([[a]]),
        np.ones((1, 1)),
        (0,),
        ("u",),
        gain([[correction]], 1.0),
        Injection.STATE,
        1.0,
    )


@pytest.mark.parametrize(("a", "correction"), [(1.05, 0.6), (1.2, 1.0), (1.4, 1.1)])
def test_one_state_is_certified_up_to_the_rate_at_which_its_second_moment_stays(a: float, correction: float) -> None:
    """``p a^2 + (1 - p) (a - l)^2 < 1``, and the gain of ``P = 1 + ...``: by hand, ``gamma^2`` solves the Riccati equation with two steps."""
    observer, caught = scalar(a, correction), (a - correction) ** 2
    found = relift_certificate(observer, scales=NO_NOISE)
    most = (1 - caught) / (a**2 - caught)
    assert dropout_bound(found, observer, 0.97 * most).gain is not None
    lost = dropout_bound(found, observer, 1.03 * most)
    assert lost.gain is None
    assert "grows" in lost.reason
    p = most / 2
    second, mean = p * a**2 + (1 - p) * caught, p * a + (1 - p) * (a - correction)
    P = np.linspace(1, 400, 2_000_000)
    # P = 1 + s P + (m P)^2 / (g^2 - P) has a solution from the least gain on
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.sqrt(np.where(P * (1 - second) > 1, P + (mean * P) ** 2 / (P * (1 - second) - 1), np.inf).min())
    got = dropout_bound(found, observer, p).gain
    assert got is not None
    assert level <= got <= 1.1 * level


@pytest.mark.parametrize("runtime", [{}, {"delay": 1}, {"correction": np.full(4, 0.05)}])
def test_simulated_losses_stay_below_the_gain(runtime: dict[str, object]) -> None:
    rng = np.random.default_rng(2)
    lifting = Lifting(("a", "b", "c"), ("0.2*sin(3*a)",), inputs=("u",))
    A = np.zeros((4, 4))
    A[:3] = np.hstack([0.85 * np.linalg.qr(rng.standard_normal((3, 3)))[0], 0.1 * rng.standard_normal((3, 1))])
    B, D = (
        np.vstack([rng.standard_normal((3, 1)), [[0.0]]]),
        np.array([[0.5], [0.3], [-0.3], [0.0]]) * (0.2 if "correction" in runtime else 1.0),
    )
    o = Observer("o", lifting, A, B, (0,), ("u",), gain(D, 0.01), Injection.STATE, 0.01, runtime=Runtime(**runtime))  # type: ignore[arg-type]
    certificate = relift_certificate(o, mismatch=False)
    rate = 0.3
    found = dropout_bound(certificate, o, rate)
    assert found.gain is not None
    assert found.gain >= 0.999 * (certificate.lower_bound or 0.0)
    w = attack(certificate, o, steps=5000).disturbance
    count, late = 300, o.runtime.delay
    u = rng.standard_normal((len(w) + 1, 1, 1))
    for size in (1e-2, 1.0):
        x = np.zeros((len(w) + 1, 1, 3))
        for k in range(len(w)):
            x[k + 1] = lifting.lift(x[k]) @ A[:3].T + u[k] @ B[:3].T + size * w[k, :3]
        y = x[np.maximum(np.arange(len(x)) - late, 0)][..., :1].copy()
        y[late:-1] += size * w[late:, 3:, None]
        y[0] = x[0, :, :1]
        y = np.repeat(y, count, axis=1)
        lost = rng.random(y.shape) < rate
        lost[0] = False
        estimates = run_observer(o, np.where(lost, np.nan, y), np.repeat(u, count, axis=1))
        energy = np.sum((x - estimates) ** 2, axis=(0, 2)).mean()
        share = np.sqrt(energy / np.sum((size * w) ** 2)) / found.gain
        assert 0.1 < share <= 1


def test_rates_of_single_measurements_and_what_is_not_certified() -> None:
    lifting = Lifting(("a", "b"))
    A, K = np.array([[1.02, 0.1], [0.0, 1.01]]), gain([[0.6, 0.0], [0.0, 0.6]], 1.0)
    two = Observer("two", lifting, A, np.zeros((2, 1)), (0, 1), ("u",), K, Injection.STATE, 1.0)
    found = relift_certificate(two)
    none, first, both = (dropout_bound(found, two, rates).gain for rates in (0.0, (0.3, 0.0), 0.3))
    assert none is not None
    assert first is not None
    assert both is not None
    assert none < first < both
    assert none == pytest.approx(found.gain, rel=0.05)
    grows = replace(two, controller=gain(np.zeros((2, 2)), 1.0))
    assert dropout_bound(relift_certificate(grows), grows, 0.1).gain is None
