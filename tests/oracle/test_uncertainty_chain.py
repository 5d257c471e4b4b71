"""Responses of chains of sections in closed form, against solves and against 40 digits."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from kros.core import StateSpace
from kros.core.lti import block_diagonal, gain
from kros.uncertainty.fits.diagonal_response import diagonal_response
from kros.uncertainty.fits.sections import Sections

DT = 1e-3
FREQS = np.geomspace(1e-4, 499.0, 200)


def _systems() -> list[StateSpace]:
    rng = np.random.default_rng(4)
    spread = Sections.spread(
        [np.array([-18.0, -6.0]), np.array([-3.0]), np.array([-9.0, -1.0])], [4, 1, 3], np.log(8.0)
    )
    return spread.moved(0.8 * rng.normal(size=len(spread.owner)), (-30.0, 5.0)).systems(DT)


def test_diagonal_weights_respond_as_solves_say() -> None:
    weight = block_diagonal(_systems())
    np.testing.assert_allclose(
        diagonal_response(weight, FREQS), np.einsum("fii->fi", weight.frequency_response(FREQS)), rtol=1e-11, atol=0
    )


def test_entries_respond_as_in_high_precision() -> None:
    system, freqs = _systems()[0], FREQS[::40]
    found = diagonal_response(system, freqs)[:, 0]
    with mpmath.workdps(40):
        for freq, value in zip(freqs, found, strict=True):
            z = mpmath.exp(2j * mpmath.pi * mpmath.mpf(float(freq)) * mpmath.mpf(DT))
            states = mpmath.lu_solve(
                z * mpmath.eye(system.n_states) - mpmath.matrix(system.A.tolist()), mpmath.matrix(system.B.tolist())
            )
            exact = complex((mpmath.matrix(system.C.tolist()) * states)[0]) + system.D[0, 0]
            assert abs(value - exact) <= 1e-11 * abs(exact)


@pytest.mark.parametrize("dt", [0.0, DT])
def test_coupled_and_static_systems_respond_too(dt: float) -> None:
    rng = np.random.default_rng(5)
    coupled = StateSpace(
        -np.eye(4) + 0.2 * rng.normal(size=(4, 4)), rng.normal(size=(4, 3)), rng.normal(size=(3, 4)), np.eye(3), dt
    )
    np.testing.assert_allclose(
        diagonal_response(coupled, FREQS), np.einsum("fii->fi", coupled.frequency_response(FREQS)), rtol=1e-10
    )
    np.testing.assert_array_equal(
        diagonal_response(gain(np.diag([2.0, 3.0]), dt), FREQS), np.tile([2.0, 3.0], (len(FREQS), 1))
    )
