"""Where weights are checked, what counts between sampled responses, and what degenerate magnitudes give: cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core import KrosError, StateSpace
from kros.core.errors import ConfigError
from kros.core.frequency import log_grid
from kros.uncertainty import quantify_systems
from kros.uncertainty.fits.sections import Sections
from kros.uncertainty.fits.spectral import RationalMagnitude, cascade, roots, spectral_factor
from kros.uncertainty.responses import unresolved_peaks
from kros.uncertainty.weights.check import between_points, checking_grid, joined, nearest
from kros.uncertainty.weights.pencils import ResidualSystems, peaks_hz


def test_joined_frequencies_increase_and_none_is_there_twice() -> None:
    freqs, index = joined(np.array([1.0, 2.0, 4.0]), np.array([3.0, 2.0 * (1 + 1e-12), 0.5, 3.0, 5.0]))
    np.testing.assert_array_equal(freqs, [0.5, 1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_array_equal(index, [5, 0, 1, 3, 2, 7])
    alone, at = joined(np.array([1.0]), np.array([1.0, 2.0]))
    np.testing.assert_array_equal(alone, [1.0, 2.0])
    np.testing.assert_array_equal(at, [0, 2])
    np.testing.assert_array_equal(joined(np.array([1.0, 2.0]), np.zeros(0))[0], [1.0, 2.0])


def test_the_checking_grid_reaches_from_zero_to_nyquist_and_holds_what_is_asked_for() -> None:
    given = np.array([0.01, 0.1, 0.2])
    grid = checking_grid(given, 1.0, 4, np.array([0.15]))
    assert grid[0] == 0.0
    assert grid[-1] == 0.5
    assert np.isin([*given, 0.15], grid).all()
    assert np.all(np.diff(grid) > 0)
    assert ((grid > 0.01) & (grid < 0.1)).sum() == 3
    below = grid[(grid > 0) & (grid < 0.01)]
    assert len(below) == 16
    assert np.tan(np.pi * below[0]) == pytest.approx(1e-4 * np.tan(np.pi * 0.01))
    assert np.tan(np.pi * grid[-2]) ** 2 == pytest.approx(1e4 * np.tan(np.pi * 0.2) ** 2)
    np.testing.assert_array_equal(checking_grid(np.array([0.0, 0.5]), 1.0, 1)[[0, -1]], [0.0, 0.5])
    filled = checking_grid(given, 1.0, 1, filled=True)
    assert np.isin(given, filled).all()
    assert np.diff(filled).max() <= 0.0050001
    inner = filled[filled > 0]
    assert (inner[1:] / inner[:-1]).max() <= 10 ** (1 / 29)


def test_the_nearest_point_stands_for_what_is_beyond_the_ends() -> None:
    np.testing.assert_array_equal(nearest(np.array([1.0, 2.0, 4.0]), np.array([0.0, 1.4, 1.6, 2.9, 3.1, 9.0])), [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(nearest(np.array([1.0]), np.array([0.0, 5.0])), [0, 0])


def test_residuals_between_points_are_three_decibels_below_the_smaller_neighbour() -> None:
    E = np.array([4.0, 1.0, 2.0, 0.0])[None, :, None, None] * np.array([[1.0, 0.0], [0.0, -0.5j]])
    held = between_points(E, np.array([1.0, 2.0, 4.0, 8.0]))(np.array([0.5, 1.0, 1.1, 1.9, 2.0, 2.5, 3.5, 4.5, 7.0, 20.0]))
    dip = 10 ** (-3 / 20)
    np.testing.assert_allclose(np.abs(held[0, :, 0, 0]), [4, 4, dip, dip, 1, dip, dip, 0, 0, 0])
    np.testing.assert_allclose(held[0, :, 1, 1], -0.5j * held[0, :, 0, 0])
    np.testing.assert_allclose(between_points(E[:, :1], np.array([1.0]))(np.array([0.2, 3.0]))[0, :, 0, 0], 4.0)


def test_a_maximum_is_resolved_when_both_neighbours_are_within_three_decibels() -> None:
    bound = np.array([9.0, 1.0, 1.5, 1.2, 1.0, 1.4, 1.3, 1.2, 1.0, 3.0])
    np.testing.assert_array_equal(unresolved_peaks(bound), [2])
    np.testing.assert_array_equal(unresolved_peaks(np.array([1.0, 1.3, 1.0])), [])
    np.testing.assert_array_equal(unresolved_peaks(np.array([1e-12, 1e-10, 1e-12, 1.0])), [])
    np.testing.assert_array_equal(unresolved_peaks(np.array([1.0, 2.0])), [])


def pair(radius: float, angle: float, gain: float = 1.0) -> StateSpace:
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return StateSpace(A, [[1.0], [0.0]], [[gain, 0.2]], [[1.0]], 1.0)


def test_only_modes_that_a_grid_passes_over_are_looked_at() -> None:
    light, dull = pair(0.9999, 0.5), pair(0.5, 1.0)
    units = StateSpace(*(np.stack([getattr(s, x) for s in (light, dull)]) for x in "ABCD"), 1.0)
    systems = ResidualSystems("additive", dull, units)
    coarse = np.linspace(0, 0.5, 50)
    found = peaks_hz(systems, coarse, 1.0)
    width = 1e-4 / (2 * np.pi)
    np.testing.assert_allclose(found, 0.5 / (2 * np.pi) + width * np.array([-3, -1, 0, 1, 3]), rtol=0, atol=0.02 * width)
    assert not peaks_hz(systems, np.linspace(0, 0.5, 200000), 1.0).size
    inverse = ResidualSystems("inverse_input_multiplicative", dull, units)  # the pole of the unit is a zero of the residual, and a bend
    assert np.abs(peaks_hz(inverse, coarse, 1.0) - 0.5 / (2 * np.pi)).min() < width / 100
    assert not peaks_hz(systems, coarse[coarse < 0.07], 1.0).size


@pytest.mark.parametrize("form", ["inverse_input_multiplicative", "inverse_additive", "inverse_output_multiplicative"])
def test_zeros_of_what_is_inverted_are_peaks(form: str) -> None:
    """`1 / G` has light poles at the zeros of the unit, which are those of the inverse system."""
    heavy = pair(0.7, 1.0)
    inverse = StateSpace(pair(0.9999, 1.2).A, [[1.0], [0.0]], [[0.3, 0.1]], [[1.0]], 1.0)
    unit = StateSpace(inverse.A - inverse.B @ inverse.C, inverse.B, -inverse.C, [[1.0]], 1.0)
    assert unit.is_stable()
    units = StateSpace(*(np.stack([getattr(s, x) for s in (unit, heavy)]) for x in "ABCD"), 1.0)
    found = peaks_hz(ResidualSystems(form, heavy, units), np.linspace(0, 0.5, 50), 1.0)
    assert np.abs(found - 1.2 / (2 * np.pi)).min() < 1e-5


def test_a_magnitude_that_is_infinite_or_zero_at_an_end_has_no_spectral_factor() -> None:
    knots = np.array([0.1, 1.0])
    for n, d in (
        ([1, 1, 1], [1, 1, 0]),
        ([1, 1, 0], [1, 1, 1]),
        ([1, 1, 1], [0, 1, 1]),
        ([0, 0, 0], [1, 1, 1]),
        ([1, 1, 1], [1, 1, np.nan]),
    ):
        with pytest.raises(KrosError):
            spectral_factor(RationalMagnitude(np.array(n, float), np.array(d, float), knots), 1.0)


def test_a_pole_on_the_unit_circle_in_double_precision_is_refused() -> None:
    with pytest.raises(KrosError, match="unit circle"):
        spectral_factor(RationalMagnitude(np.array([1.0, 1.0]), np.array([1.0, 1e-32]), np.array([1.0])), 1.0)
    with pytest.raises(KrosError, match="conjugate pairs"):
        cascade([-0.5 + 0.1j, -0.3 + 0j], [-0.2 + 0j, -0.1 + 0j], 1.0, 1.0)


def test_negative_numerator_and_denominator_are_a_magnitude() -> None:
    n, d, knots = np.array([2.0, 3.0]), np.array([1.0, 5.0]), np.array([0.3])
    plus, minus = (spectral_factor(RationalMagnitude(s * n, s * d, knots), 1.0) for s in (1, -1))
    np.testing.assert_allclose(plus.frequency_response([0.1]), minus.frequency_response([0.1]))
    assert abs(plus.frequency_response([0.0])[0, 0, 0]) == pytest.approx(np.sqrt(2.0))


def test_roots_of_nothing_are_refused() -> None:
    with pytest.raises(KrosError, match="did not settle"):
        roots(np.zeros(3), np.array([0.1, 1.0]))


def test_sections_are_not_made_of_a_magnitude_without_a_level() -> None:
    start = Sections.spread([np.zeros(1)], [2], 1.0)
    with pytest.raises(KrosError, match="DC or Nyquist"):
        start.like(np.array([0]), RationalMagnitude(np.array([1.0, 1.0]), np.array([1.0, 0.0]), np.array([1.0])))


def test_a_grid_does_not_begin_below_what_the_longest_recording_resolves() -> None:
    assert log_grid(1e-3, 50, longest_s=10.0)[0] == pytest.approx(0.1)
    assert log_grid(1e-3, 50, longest_s=1e9)[0] == pytest.approx(5e-4)
    assert log_grid(1e-3, 50)[0] == pytest.approx(5e-4)
    assert log_grid(1e-3, 50, longest_s=0.002)[[0, -1]] == pytest.approx([250.0, 500.0])
    with pytest.raises(ConfigError, match="length"):
        log_grid(1e-3, 50, longest_s=0.0)


def test_models_from_recordings_are_quantified_from_their_lowest_frequency() -> None:
    class Recorded:
        unit_ids, longest_s = ("a", "b"), 50.0
        output_scale = input_scale = np.ones(1)

        def systems(self, units: tuple[str, ...]) -> list[StateSpace]:
            return [pair(0.7, 1.0), pair(0.7, 1.0, 1.2)]

    found = quantify_systems(Recorded(), "additive", max_order=1, tolerance_db=20.0)
    assert found.freqs_hz[0] == pytest.approx(0.02)
    assert found.freqs_hz[-1] == 0.5
