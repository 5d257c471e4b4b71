"""Frequency grids, the nominal's choice, and the spectral factor."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.errors import ConfigError
from kros.core.frequency import log_grid, nyquist_hz
from kros.uncertainty.forms import check_grid
from kros.uncertainty.weights.sections import bilinear_squared

DT = 1e-3


def test_default_grid_spans_six_decades_up_to_nyquist() -> None:
    grid = log_grid(DT)
    assert len(grid) == 1000
    assert grid[-1] == 500.0 == nyquist_hz(DT)
    assert grid[0] == pytest.approx(500e-6)
    np.testing.assert_allclose(np.diff(np.log(grid)), np.log(10) * 6 / 999)


def test_bilinear_variable_keeps_relative_precision_near_dc() -> None:
    assert bilinear_squared(1e-9, DT) == pytest.approx((np.pi * 1e-12) ** 2, rel=1e-14)
    assert bilinear_squared([0.0, 250.0, 500.0], DT).tolist() == [0.0, pytest.approx(1.0), np.inf]


@pytest.mark.parametrize("bad", [[2.0, 1.0], [-1.0, 1.0], [1.0, 501.0], [np.nan], [], [[1.0]]])
def test_bad_grids_are_refused(bad: list[float]) -> None:
    with pytest.raises(ConfigError, match="grid"):
        check_grid(bad, DT)
    with pytest.raises(ConfigError):
        nyquist_hz(0.0)
