"""What the paper's fit loses on the way to a discrete weight, and what the discrete fit keeps."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from kros.core.lti import StateSpace
from kros.uncertainty import fit_magnitude, quantify

DT = 1e-3
FREQS = np.geomspace(1e-3, 500.0, 200)


@pytest.fixture(scope="module")
def paper() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "paper_slsqp.py"
    spec = importlib.util.spec_from_file_location("paper_slsqp", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_sampling_breaks_a_continuous_bound(paper: ModuleType) -> None:
    """A lag with its corner at 100 Hz: above the data before sampling, below them after; the discrete fit stays above, and
    is tighter than the sampled one once that is lifted."""
    magnitude = 1 / np.hypot(1.0, FREQS / 100.0) + 0.02
    fitted = paper.fit(2 * np.pi * FREQS, magnitude, 1)
    before = np.abs(paper.response(fitted, 2 * np.pi * FREQS)) / magnitude
    assert before.min() > 1 - 1e-6
    held = np.abs(paper.sampled(fitted, DT, "zoh").frequency_response(FREQS)[:, 0, 0]) / magnitude
    assert held.min() < 0.95
    system = fit_magnitude(FREQS, magnitude, DT, max_order=1, tolerance_db=0.0).system
    discrete = np.abs(system.frequency_response(FREQS)[:, 0, 0]) / magnitude
    assert discrete.min() >= 1
    assert discrete.max() <= held.max() / held.min()


def test_peaks_that_no_grid_point_meets_are_covered() -> None:
    """Light resonances, continuous, a hundred points over four decades; an order in between whose best magnitude vanishes at infinity."""
    tops = np.array([1.0, 0.93, 1.04])
    A = np.zeros((3, 2, 2))
    A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = 1.0, -(tops**2), -0.004 * tops
    C = np.stack([tops[:, None] ** 2, np.zeros((3, 1))], axis=-1)
    units = StateSpace(A, np.tile([[0.0], [1.0]], (3, 1, 1)), C, np.linspace(0.01, 0.02, 3).reshape(-1, 1, 1), 0.0)
    model = quantify(
        units, "additive", np.geomspace(1e-2, 1e2, 100) / (2 * np.pi), nominal=0, max_order=2, tolerance_db=60.0
    )
    freqs = np.geomspace(1e-2, 1e2, 20000) / (2 * np.pi)
    response = units.frequency_response(freqs)[:, :, 0, 0]
    allowed = np.abs(model.weight.left.frequency_response(freqs)[:, 0, 0])
    assert (np.abs(response - response[0]) <= allowed).all()
