"""Parts of worst-case synthesis, one by one: multipliers, bounding spectra and quadrature against what each is by
definition."""

import numpy as np
import pytest

from kros.core import StateSpace, gain, h2_norm
from kros.synthesis import ObserverProblem
from kros.synthesis.worst_case.certificate import certify_errors

DT = 1.0


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.7, np.pi])
def test_a_certificate_sees_resonances_that_a_grid_passes_over(angle):
    """A scalar perturbation of the input: the worst case is the norm of the plant, whose whole energy is in a band of a
    ten-millionth of the range."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    A = (1 - 1e-7) * turn if np.sin(angle) > 1e-9 else np.diag([(1 - 1e-7) * np.cos(angle), 0.5])
    nominal = StateSpace(A, [[0.5], [0.2]], np.eye(2), np.zeros((2, 1)), DT)
    weights, scales = (gain([[0.01]], DT), gain([[1.0]], DT)), ([1.0], [1.0, 1.0], [0.1])
    case = ObserverProblem(nominal, [[1.0, 0.0]], *weights, *scales, form="input_multiplicative")
    nothing = gain(np.zeros((2, 1)), DT)
    value = certify_errors(case, case.error_system(nothing))
    assert value == pytest.approx(0.01 * h2_norm(nominal), rel=1e-4)
