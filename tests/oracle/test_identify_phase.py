"""Phase calibration against signals with a known phase and lag, and the published way as a check."""

import numpy as np
import pytest

from kros.core.errors import IdentificationError
from kros.identify import PhaseCalibration, PhaseSpec
from kros.identify.calibration import find_segments, resolve_branches, unit_phase

SPEC = PhaseSpec()
DT = 1e-3


def recording(phase, lag, directions=(1, -1, 1, -1), noise=0.0, seed=0, speed=np.pi):
    """Constant-velocity stretches with rests between them; the disturbance reaches the error with a lag."""
    rng = np.random.default_rng(seed)
    reference = np.concatenate(
        [np.concatenate([np.zeros(200), np.full(1500, d * speed)]) for d in directions] + [np.zeros(200)]
    )
    angle = np.cumsum(reference) * DT + rng.uniform(0, 1)
    direction = np.sign(reference)
    error = 0.02 * np.sin(100 * angle + phase + direction * lag) * np.abs(direction)
    error += (
        0.005 * np.sin(200 * angle + 1.0) + 0.01 * np.linspace(-1, 1, len(angle)) + noise * rng.normal(size=len(angle))
    )
    return angle, reference, reference - error


@pytest.mark.parametrize("lag", [-0.4, -1.5, -np.pi / 2, -1.65, -2.5])
@pytest.mark.parametrize("phase", [0.1, 2.0, 4.5, 6.2])
def test_phase_and_lag_are_recovered_modulo_pi(phase, lag):
    found = unit_phase(find_segments(*recording(phase, lag), DT, SPEC), "1", SPEC)
    assert abs(np.sin(found.phase_rad - phase)) < 1e-3
    assert abs(np.sin(found.lag_rad - lag)) < 1e-3
    assert found.concentration > 0.999


def test_the_published_mean_over_both_directions_cancels_where_this_one_works():
    segments = find_segments(*recording(1.0, -np.pi / 2, noise=0.002), DT, SPEC)
    resultant = np.abs(np.mean([np.exp(1j * s.phase) for s in segments]))
    assert resultant < 0.05
    assert abs(np.sin(unit_phase(segments, "1", SPEC).phase_rad - 1.0)) < 0.02


@pytest.mark.parametrize("mean_lag", [-0.7, -np.pi / 2, -2.9])
def test_branches_are_resolved_for_the_whole_population(mean_lag):
    """Every unit must land on the same branch, also where lags straddle 90 degrees; one pi common to all is free."""
    rng = np.random.default_rng(3)
    truth = {f"{i:03d}": (rng.uniform(0, 2 * np.pi), mean_lag + rng.normal(scale=0.15)) for i in range(20)}
    units = {
        u: unit_phase(find_segments(*recording(*values, seed=i), DT, SPEC), u, SPEC)
        for i, (u, values) in enumerate(truth.items())
    }
    calibration = resolve_branches(units, list(units), SPEC)
    offsets = np.array([np.exp(1j * (calibration.units[u].phase_rad - truth[u][0])) for u in truth])
    common = np.sign(offsets[0].real)
    np.testing.assert_allclose(offsets, common, atol=5e-3)
    assert -np.pi <= calibration.lag_rad < 0


def test_a_new_unit_follows_the_stored_branch(tmp_path):
    units = {str(i): unit_phase(find_segments(*recording(i, -1.5, seed=i), DT, SPEC), str(i), SPEC) for i in range(5)}
    calibration = resolve_branches(units, list(units), SPEC)
    calibration.save(tmp_path)
    loaded = PhaseCalibration.load(tmp_path)
    shift = np.angle(np.exp(1j * (calibration.units["2"].phase_rad - 2)))
    found = loaded.calibrate(find_segments(*recording(3.3, -1.62, seed=9), DT, SPEC), "new")
    assert np.abs(np.angle(np.exp(1j * (found.phase_rad - 3.3 - shift)))) < 5e-3


def test_one_direction_only_is_an_error():
    segments = find_segments(*recording(1.0, -1.0, directions=(1, 1)), DT, SPEC)
    with pytest.raises(IdentificationError, match=r"unit 7: needs constant-velocity segments.*'reverse': 0"):
        unit_phase(segments, "7", SPEC)


def test_disagreeing_segments_are_reported(caplog):
    rng = np.random.default_rng(0)
    parts = [recording(rng.uniform(0, 6), rng.uniform(-3, 0), seed=i) for i in range(8)]
    segments = [s for part in parts for s in find_segments(*part, DT, SPEC)]
    assert unit_phase(segments, "x", SPEC).concentration < 0.8
    assert "concentration" in caplog.text
