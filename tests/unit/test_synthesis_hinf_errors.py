"""What H-infinity synthesis refuses, and how it says so."""

import numpy as np
import pytest

from kros.core import ConfigError, SynthesisError
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
    ("options", "message"), [({"tolerance": 0.0}, "tolerance should lie"), ({"tolerance": 1.0}, "tolerance should lie")]
)
def test_options_are_checked(one_state, options, message):
    with pytest.raises(ConfigError, match=message):
        hinf(one_state(), **options)


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
