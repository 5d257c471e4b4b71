"""Bad input to the synthesis layer: every refusal names what is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from kros.core import ConfigError, DataError, DimensionError, StateSpace, SynthesisError, gain, h2_norm, hinf_norm
from kros.synthesis import (
    GeneralizedPlant,
    Injection,
    ObserverProblem,
    Status,
    Synthesis,
    h2,
    hinf,
    kalman,
    mixed,
    worst_case_h2,
)
from kros.synthesis.worst_case.certificate import certify_errors

DT = 1e-3


def problem(**changes):
    nominal = StateSpace([[0.99, 0.01], [0.0, 0.9]], [[0.0], [0.1]], np.eye(2), np.zeros((2, 1)), DT)
    parts = {
        "nominal": nominal,
        "C": [[1.0, 0.0]],
        "W_L": gain([[0.2]], DT),
        "W_R": gain([[1.0]], DT),
        "input_scale": [1.0],
        "output_scale": [1.0, 2.0],
        "noise": [1e-3],
    }
    return ObserverProblem(**{**parts, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"B1": [[1.0], [0.0]]}, r"B1 should have shape \(1, 1\)"),
        ({"D12": [[1.0]]}, r"D12 should have shape \(2, 1\)"),
        ({"C2": [[np.nan]]}, "NaN"),
        ({"dt": -1.0}, "0 for continuous time; found -1"),
        ({"dt": np.nan}, "found nan"),
        ({"dt": None}, "found None"),
        ({"A": [[1j]]}, "A should be a real matrix, found list: complex numbers"),
        ({"A": "fast"}, "A should be a real matrix, found str"),
        ({"n_w1": 3}, "n_w1 = 3 should lie between 0 and 2"),
        ({"n_z1": -1}, "n_z1 = -1"),
    ],
)
def test_generalized_plant_checks_its_shapes(one_state, changes, message):
    with pytest.raises(DimensionError, match=message):
        one_state(**changes)


@pytest.mark.parametrize(
    ("changes", "controller", "message"),
    [
        ({}, gain(np.eye(2), 1.0), "1 x 1 at 1.0 s, found 2 x 2"),
        ({}, gain([[1.0]], 0.5), "found 1 x 1 at 0.5 s"),
        ({"D22": [[1.0]]}, gain([[1.0]], 1.0), "I - D22"),
    ],
)
def test_loops_that_cannot_be_closed_are_refused(one_state, changes, controller, message):
    with pytest.raises(DimensionError, match=message):
        one_state(**changes).close(controller)


@pytest.mark.parametrize(
    ("method", "plant", "message"),
    [
        (h2, lambda one: gain([[1.0]], 1.0), r"GeneralizedPlant .* found StateSpace"),
        (hinf, lambda one: gain([[1.0]], 1.0), r"GeneralizedPlant .* found StateSpace"),
        (mixed, lambda one: one(), "needs ObserverProblem, found GeneralizedPlant"),
    ],
)
def test_methods_want_a_plant_of_their_kind(one_state, method, plant, message):
    with pytest.raises((ConfigError, DimensionError), match=message):
        method(plant(one_state))


@pytest.mark.parametrize("dt", [0.0, 1.0])
@pytest.mark.parametrize("method", [h2, hinf])
def test_without_measurement_or_control_the_open_loop_is_optimal(one_state, method, dt):
    A = [[0.9 if dt else -0.9]]
    blind = one_state(A=A, dt=dt, C2=np.zeros((0, 1)), D21=np.zeros((0, 2)), D22=np.zeros((0, 1)))
    tied = one_state(A=A, dt=dt, B2=np.zeros((1, 0)), D12=np.zeros((2, 0)), D22=np.zeros((1, 0)))
    alone = StateSpace(A, [[1.0]], [[1.0]], [[0.0]], dt)
    for case in (blind, tied):
        found = method(case)
        assert found.h2_norm == pytest.approx(h2_norm(alone))
        assert found.hinf_norm == pytest.approx(hinf_norm(alone))


@pytest.mark.parametrize("method", [h2, hinf])
def test_an_optimum_of_zero_is_an_optimum(method):
    # every disturbance is measured as it enters, and the control can undo it: T = 0, up to rounding
    rng = np.random.default_rng(3)
    B2, D12, D21, Q = rng.standard_normal((3, 2)), *rng.standard_normal((3, 2, 2))
    C1, zero = rng.standard_normal((2, 3)), np.zeros((2, 2))
    case = GeneralizedPlant(
        np.diag([0.9, 0.5, -0.3]), B2 @ Q @ D21, B2, C1, np.zeros((2, 3)), D12 @ Q @ D21, D12, D21, zero, 0.1
    )
    found = method(case)
    assert found.status is Status.OPTIMAL
    assert found.lower_bound <= found.h2_norm < 1e-9


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"C": [[1.0, 0.0, 0.0]]}, r"C should be \(q, 2\)"),
        ({"noise": [0.0]}, "noise should be 1 positive"),
        ({"noise": [1e-3, 1e-3]}, "noise should be 1 positive"),
        ({"input_scale": [-1.0]}, "input_scale should be 1 positive"),
        ({"output_scale": [1.0]}, "output_scale should be 2 positive"),
        ({"W_L": gain([[0.2]], 0.5)}, "W_L is sampled at 0.5 s, the nominal model at 0.001 s"),
        (
            {"W_R": gain(np.eye(2), DT)},
            "W_R should be any x 1 for inverse_input_multiplicative uncertainty, found 2 x 2",
        ),
        ({"form": "additive"}, "W_L should be 2 x any for additive uncertainty, found 1 x 1"),
        ({"form": "inverse_additive"}, "W_R should be any x 2 for inverse_additive uncertainty, found 1 x 1"),
        ({"W_L": np.eye(1)}, "found ndarray"),
        ({"n_original": 3}, "n_original = 3"),
        ({"injection": Injection.NONE}, "found NONE"),
        ({"remainder_left": gain(np.eye(2), DT)}, "come together"),
    ],
)
def test_observer_problem_checks_its_parts(changes, message):
    with pytest.raises(DimensionError, match=message):
        problem(**changes)


DRIFTING = StateSpace(np.diag([1.0, 0.9]), [[1.0], [0.1]], np.eye(2), np.zeros((2, 1)), DT)
CONTINUOUS = StateSpace(-np.eye(2), [[0.0], [0.1]], np.eye(2), np.zeros((2, 1)), 0.0)


@pytest.mark.parametrize("method", [worst_case_h2, mixed])
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"W_L": gain([[1.0]], DT)}, r"\|\|N\|\| = 1 should be below 1"),
        ({"W_L": StateSpace([[1.0]], [[1.0]], [[0.1]], [[0.1]], DT)}, "W_L has spectral radius 1"),
        ({"nominal": DRIFTING, "C": [[0.0, 1.0]]}, "not detectable, mode 1"),
        ({"nominal": DRIFTING}, "nominal has spectral radius 1"),
        ({"nominal": CONTINUOUS, "W_L": gain([[0.2]], 0.0), "W_R": gain([[1.0]], 0.0)}, "sample it"),
    ],
)
def test_problems_without_a_sound_answer_are_refused(method, changes, message):
    with pytest.raises(SynthesisError, match=message):
        method(problem(**changes))


def test_certificate_refuses_an_unstable_observer():
    with pytest.raises(SynthesisError, match="spectral radius"):
        certify_errors(problem(), problem().error_system(gain([[-1.0], [0.0]], DT)))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([[1.0, 0], [0, 1.2]], [[1.0, 0]], np.eye(2), [[1.0]]), SynthesisError, "not detectable, mode 1.2"),
        (([[0.5]], [[1.0]], [[1.0]], [[0.0]]), SynthesisError, "R is not positive definite"),
        (([[0.5]], [[1.0]], [[-1.0]], [[1.0]]), SynthesisError, "eigenvalue -1"),
        (([[0.5]], [[1.0, 0]], [[1.0]], [[1.0]]), DimensionError, r"C \(q, n\)"),
        (([[1.0]], [[1.0]], [[0.0]], [[1.0]]), SynthesisError, "unit circle|no stabilising|residual"),
    ],
)
def test_kalman_refusals(arguments, error, message):
    with pytest.raises(error, match=message):
        kalman(*arguments)


def test_result_survives_saving(tmp_path):
    found = kalman([[0.9]], [[1.0]], [[1.0]], [[1.0]])
    full = replace(found, status=Status.INACCURATE, injection=Injection.INPUT, worst_case_h2=2.5, notes=("one", "two"))
    for synthesis in (found, full):
        synthesis.save(tmp_path)
        back = Synthesis.load(tmp_path)
        for name in Synthesis.__dataclass_fields__:
            if name != "controller":
                assert getattr(back, name) == getattr(synthesis, name)
        assert all(np.array_equal(getattr(back.controller, x), getattr(synthesis.controller, x)) for x in "ABCD")
        assert back.controller.dt == synthesis.controller.dt
    with pytest.raises(DataError, match="there is no file"):
        Synthesis.load(tmp_path / "elsewhere")


@pytest.mark.parametrize("method", [worst_case_h2, mixed])
def test_where_all_units_are_alike_nothing_is_corrected(method):
    found = method(problem(W_L=gain([[0.0]], DT)))
    assert found.worst_case_h2 == 0
    assert found.lower_bound == 0
    assert not np.any(found.controller.D)


# ------------------------------------------------------------------ H-infinity
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


@pytest.mark.parametrize("tolerance", [0.0, 1.0])
def test_a_tolerance_that_is_none_is_refused(one_state, tolerance):
    with pytest.raises(ConfigError, match="tolerance should lie"):
        hinf(one_state(), tolerance=tolerance)


def test_a_pole_at_the_end_of_the_map_is_named(one_state):
    with pytest.raises(SynthesisError, match="the plant has a pole at z = -1"):
        hinf(one_state(A=[[-1.0]]))
