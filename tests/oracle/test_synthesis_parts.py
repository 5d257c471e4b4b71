"""Parts of worst-case synthesis, one by one: multipliers, bounding spectra and quadrature against what each is by
definition."""

import numpy as np
import pytest

from kros.core import StateSpace, gain, h2_norm
from kros.synthesis import ObserverProblem
from kros.synthesis.worst_case.certificate import certify

DT = 1.0


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.7, np.pi])
def test_a_certificate_sees_resonances_that_a_grid_passes_over(angle):
    """No uncertainty: what is left is the norm of the loop, whose whole energy is in a band of a ten-millionth of the
    range."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    A = (1 - 1e-7) * turn if np.sin(angle) > 1e-9 else np.diag([(1 - 1e-7) * np.cos(angle), 0.5])
    nominal = StateSpace(A, [[0.5], [0.2]], np.eye(2), np.zeros((2, 1)), DT)
    none = gain([[0.0]], DT)
    case = ObserverProblem(nominal, [[1.0, 0.0]], none, none, [1.0], [1.0, 1.0], [0.1], process_noise=[0.01, 0.02])
    nothing = gain(np.zeros((2, 1)), DT)
    value, error = certify(case, nothing)
    loop = case.error_system(nothing)
    assert value == pytest.approx(
        h2_norm(StateSpace(loop.A, loop.B[:, 3:], loop.C, loop.D[:, 3:], DT)), rel=1e-4
    )  # noises alone
    assert error < 1e-3 * value
