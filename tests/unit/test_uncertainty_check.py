"""Frequency grids, where weights are checked, and what degenerate magnitudes give: cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from residuals import of_systems

from kros.core import ConfigError, KrosError, StateSpace
from kros.core.frequency import log_grid, nyquist_hz
from kros.uncertainty import quantify
from kros.uncertainty.forms import check_grid
from kros.uncertainty.weights.magnitude import RationalMagnitude


def pair(radius: float, angle: float, gain: float = 1.0) -> StateSpace:
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return StateSpace(A, [[1.0], [0.0]], [[gain, 0.2]], [[1.0]], 1.0)


@pytest.mark.parametrize("form", ["inverse_input_multiplicative", "inverse_additive", "inverse_output_multiplicative"])
def test_zeros_of_what_is_inverted_are_peaks(form: str) -> None:
    """`1 / G` has light poles at the zeros of the unit, which are those of the inverse system."""
    heavy = pair(0.7, 1.0)
    inverse = StateSpace(pair(0.9999, 1.2).A, [[1.0], [0.0]], [[0.3, 0.1]], [[1.0]], 1.0)
    unit = StateSpace(inverse.A - inverse.B @ inverse.C, inverse.B, -inverse.C, [[1.0]], 1.0)
    assert unit.is_stable()
    units = StateSpace(*(np.stack([getattr(s, x) for s in (unit, heavy)]) for x in "ABCD"), 1.0)
    found = of_systems(form, heavy, units).modes_hz(np.linspace(0, 0.5, 50), 1.0)
    assert np.abs(found - 1.2 / (2 * np.pi)).min() < 1e-5


def test_a_magnitude_that_is_infinite_or_zero_at_an_end_has_no_spectral_factor() -> None:
    knots, ones = np.array([0.1, 1.0]), [1, 1, 1]
    for n, d in ((ones, [1, 1, 0]), ([1, 1, 0], ones), (ones, [0, 1, 1]), ([0, 0, 0], ones), (ones, [1, 1, np.nan])):
        with pytest.raises(KrosError):
            RationalMagnitude(np.array(n, float), np.array(d, float), knots).factor()


def test_default_grid_spans_six_decades_up_to_nyquist() -> None:
    grid = log_grid(1e-3)
    assert len(grid) == 1000
    assert grid[-1] == 500.0 == nyquist_hz(1e-3)
    np.testing.assert_allclose(np.diff(np.log(grid)), np.log(10) * 6 / 999)


@pytest.mark.parametrize("bad", [[2.0, 1.0], [-1.0, 1.0], [1.0, 501.0], [np.nan], [], [[1.0]]])
def test_bad_grids_are_refused(bad: list[float]) -> None:
    with pytest.raises(ConfigError, match="grid"):
        check_grid(bad, 1e-3)


def test_a_grid_does_not_begin_below_what_the_longest_recording_resolves() -> None:
    assert log_grid(1e-3, 50, longest_s=10.0)[0] == pytest.approx(0.1)
    assert log_grid(1e-3, 50, longest_s=1e9)[0] == pytest.approx(5e-4)
    assert log_grid(1e-3, 50)[0] == pytest.approx(5e-4)
    assert log_grid(1e-3, 50, longest_s=0.002)[[0, -1]] == pytest.approx([250.0, 500.0])


def test_models_from_recordings_are_quantified_from_their_lowest_frequency() -> None:
    class Recorded:
        unit_ids, longest_s = ("a", "b"), 50.0
        output_scale = input_scale = np.ones(1)

        def systems(self, units: tuple[str, ...]) -> list[StateSpace]:
            return [pair(0.7, 1.0), pair(0.7, 1.0, 1.2)]

    found = quantify(Recorded(), "additive", max_order=1, tolerance_db=20.0)
    assert found.freqs_hz[0] == pytest.approx(0.02)
    assert found.freqs_hz[-1] == 0.5
