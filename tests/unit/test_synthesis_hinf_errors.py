"""What H-infinity synthesis refuses, and how it says so."""

from dataclasses import replace

import numpy as np
import pytest

from kros.core import ConfigError, SynthesisError, gain, hinf_norm
from kros.synthesis import Status, hinf


@pytest.mark.parametrize(
    ("changes", "label"),
    [
        ({"A": [[1.1]], "B2": [[0.0]]}, r"A1a: \(A, B2\) stabilisable \(mode 1.1.*make the weights stable"),
        ({"A": [[1.1]], "C2": [[0.0]]}, r"A1b: \(C2, A\) detectable \(mode 1.1"),
        ({"D12": [[0.0], [0.0]]}, "A2a: D12.*add a small correction penalty"),
        ({"D21": [[0.0, 0.0]]}, "A2b: D21.*add measurement noise"),
        ({"A": [[1.0]], "C1": [[0.0], [0.0]]}, "A3: no zero.*penalise more outputs"),
        ({"A": [[-1.0]], "C1": [[0.0], [0.0]]}, "A3: no zero"),
        ({"A": [[1.0]], "B1": [[0.0, 0.0]]}, "A4: no zero.*add process noise"),
        ({"A": [[0.0]], "B1": [[0.0, 0.0]], "dt": 0.0}, "A4: no zero"),
    ],
)
def test_the_violated_assumption_is_named(one_state, changes, label):
    with pytest.raises(SynthesisError, match=f"H-infinity synthesis needs a regular generalized plant.*{label}"):
        hinf(one_state(**changes))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, "tolerance should lie"),
        ({"tolerance": 1.0}, "tolerance should lie"),
    ],
)
def test_options_are_checked(one_state, options, message):
    with pytest.raises(ConfigError, match=message):
        hinf(one_state(), **options)


def test_direct_gain_is_no_obstacle_in_continuous_time(one_state):
    direct = one_state(A=[[-1.0]], dt=0.0, D11=np.ones((2, 2)))
    found = hinf(direct)
    assert found.status is Status.OPTIMAL
    assert found.hinf_norm == pytest.approx(hinf_norm(direct.close(found.controller)))


def test_a_pole_at_the_end_of_the_map_is_named(one_state):
    with pytest.raises(SynthesisError, match="the plant has a pole at z = -1"):
        hinf(one_state(A=[[-1.0]]))


def test_an_uncontrolled_stable_mode_in_the_weights_is_fine(one_state):
    # A state that the control does not reach and y does not see, but z does: stable, so allowed.
    wide = one_state(
        A=np.diag([0.9, 0.3]),
        B1=[[1.0, 0.0], [1.0, 0.0]],
        B2=[[1.0], [0.0]],
        C1=[[1.0, 1.0], [0.0, 0.0]],
        C2=[[1.0, 0.0]],
    )
    assert hinf(wide).status is Status.OPTIMAL


def test_better_than_the_zero_gain_and_never_below_the_bound(one_state):
    rng = np.random.default_rng(0)
    for _ in range(10):
        n = int(rng.integers(1, 6))
        A = rng.standard_normal((n, n))
        A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
        B1, C1 = (
            np.hstack([rng.standard_normal((n, 2)), np.zeros((n, 1))]),
            np.vstack([rng.standard_normal((2, n)), np.zeros((1, n))]),
        )
        p = replace(
            one_state(),
            A=A,
            B1=B1,
            B2=rng.standard_normal((n, 1)),
            C1=C1,
            C2=rng.standard_normal((1, n)),
            D11=np.zeros((3, 3)),
            D12=[[0], [0], [0.1]],
            D21=[[0, 0, 0.1]],
        )
        found = hinf(p)
        assert found.lower_bound <= found.hinf_norm <= hinf_norm(p.close(gain([[0.0]], 1.0))) * (1 + 1e-5)
