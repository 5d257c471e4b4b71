"""Delays and input functions: windows, free runs, observers and factors against plain loops over samples."""

import numpy as np
import pytest
from random_models import random_observer

from kros.core.errors import ConfigError, DataError, DimensionError, IdentificationError
from kros.identify import edmd, free_run
from kros.identify.factors import Factor, lifted_factor, reduce_episode, require_excitation
from kros.lifting import Lifting
from kros.observer import run_observer
from kros.synthesis import Injection

STATES, INPUTS = ("position", "current"), ("voltage", "target")
DELAYED = Lifting(
    STATES,
    ("sin(3*position + phase)", "position[-2]", "current[-1]*voltage[-3]"),
    ("phase",),
    INPUTS,
    ("current*voltage", "cos(position[-1] + phase)*target"),
)


def by_hand(x, u, k, phase):
    """Lifted states and lifted inputs at sample k, written out."""
    theta = [*x[k], np.sin(3 * x[k, 0] + phase), x[k - 2, 0], x[k - 1, 1] * u[k - 3, 0]]
    return np.array(theta), np.array([*u[k], x[k, 1] * u[k, 0], np.cos(x[k - 1, 0] + phase) * u[k, 1]])


def recording(n_samples=40, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n_samples, 2)), rng.normal(size=(n_samples, 2))


def test_windows_hold_what_the_formulas_read():
    assert DELAYED.history == 3
    depths = {"position": 2, "current": 1, "voltage": 3}
    assert DELAYED.window.names == (
        *STATES,
        *(f"{n}[-{k}]" for n, depth in depths.items() for k in range(1, depth + 1)),
    )
    x, u = recording()
    windows = DELAYED.windows(x, u)
    assert windows.shape == (37, 8)
    for k in range(3, 40):
        theta, lifted_u = by_hand(x, u, k, 0.4)
        np.testing.assert_allclose(DELAYED.lift(windows[k - 3], {"phase": 0.4}), theta, rtol=1e-14)
        np.testing.assert_allclose(DELAYED.lift_inputs(u[k], windows[k - 3], {"phase": 0.4}), lifted_u, rtol=1e-14)


@pytest.mark.parametrize("shared", [False, True])
def test_free_run_equals_a_plain_loop(shared):
    rng = np.random.default_rng(1)
    A, B = 0.3 * rng.normal(size=(3, 5, 5)), 0.3 * rng.normal(size=(3, 5, 4))
    if shared:
        A, B = A[0], B[0]
    x0, u, phases = rng.normal(size=(3, 4, 2)), rng.normal(size=(3, 30, 2)), np.array([0.0, 1.0, 2.0])
    found = free_run(A, B, DELAYED, {"phase": phases}, x0, u)
    for i in range(3):
        x = np.zeros((30, 2))
        x[:4] = x0[i]
        for k in range(3, 29):
            theta, lifted_u = by_hand(x, u[i], k, phases[i])
            x[k + 1] = ((A if shared else A[i]) @ theta + (B if shared else B[i]) @ lifted_u)[:2]
        np.testing.assert_allclose(found[i], x, rtol=1e-11, atol=1e-12)


def test_an_episode_shorter_than_the_history_is_refused():
    x, u = recording(4)
    with pytest.raises(DataError, match="at least 5 samples for the delay of 3 in 'voltage', found 4"):
        reduce_episode(x, u, DELAYED)
    with pytest.raises(DimensionError, match=r"expected 2 inputs \('voltage', 'target'\)"):
        reduce_episode(*recording(9)[:1], np.zeros((9, 3)), DELAYED)


def test_a_bilinear_system_with_a_delay_is_found_exactly():
    """x+ = 0.9 x + 0.1 sin(x[-2]) + 0.2 u + 0.3 x u: the model is the system, and its free run is the recording."""
    rng = np.random.default_rng(3)
    u = rng.uniform(-1, 1, size=(300, 1))
    x = np.zeros((300, 1))
    x[:3, 0] = [0.5, -0.2, 0.1]
    for k in range(2, 299):
        x[k + 1] = 0.9 * x[k] + 0.1 * np.sin(x[k - 2]) + 0.2 * u[k] + 0.3 * x[k] * u[k]
    lifting = Lifting(("x",), ("sin(x[-2])",), (), ("u",), ("x*u",))
    model = edmd(lifted_factor(reduce_episode(x, u, lifting), lifting, {}, lifting).R, 2)
    np.testing.assert_allclose(model.A[0], [0.9, 0.1], atol=1e-12)
    np.testing.assert_allclose(model.B[0], [0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(free_run(model.A, model.B, lifting, {}, x[None, :3], u[None])[0], x, atol=1e-11)


@pytest.mark.parametrize("injection", [Injection.STATE, Injection.INPUT])
@pytest.mark.parametrize("order", [0, 2])
def test_batched_and_single_observers_equal_the_equations(injection, order):
    o = random_observer(DELAYED, injection, order, inputs=INPUTS)
    rng = np.random.default_rng(1)
    y, u, phases = rng.normal(size=(30, 3, 1)), rng.normal(size=(30, 3, 2)), np.array([0.0, 1.0, 2.0])
    batched = run_observer(o, y, u, {"phase": phases})
    for i, phase in enumerate(phases):
        # Before the start, states and inputs are those of the start: three samples are put in front.
        x = np.zeros((33, 2))
        x[:4, 0] = y[0, i, 0]
        held = np.concatenate([np.repeat(u[:1, i], 3, axis=0), u[:, i]])
        xc = np.zeros(order)
        for k in range(3, 32):
            nu = y[k - 3, i] - x[k, :1]
            yc = o.controller.C @ xc + o.controller.D @ nu
            theta, lifted_u = by_hand(x, held, k, phase)
            following = o.A @ theta + (o.B @ (lifted_u + yc) if injection is Injection.INPUT else o.B @ lifted_u + yc)
            xc = o.controller.A @ xc + o.controller.B @ nu
            x[k + 1] = following[:2]
        np.testing.assert_allclose(batched[:, i], x[3:], rtol=1e-10, atol=1e-10)
        running = o.start(y[0, i], {"phase": phase})
        stepped = [running.estimate] + [running.step(y[k, i], u[k, i]) for k in range(29)]
        np.testing.assert_allclose(stepped, x[3:], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("functions", "message"),
    [
        (("position[0]",), "is no earlier value"),
        (("position[-1.5]",), "whole number of samples"),
        (("position[-1:]",), "whole number of samples"),
        (("position[-1001]",), "too deep; at most 1000"),
        (("phase[-1]",), "only position, current, voltage, target have earlier values"),
        (("speed[-1]",), "there is no speed"),
        (("sin(position)[-1]",), "is not allowed"),
        (("voltage*position",), "present input voltage"),
        (("position[-1]", "1*position[-1]"), "repeat"),
        (("position*position", "position**2"), "repeat"),
        (("position",), "is 'position' itself"),
        (("position[-1] - position[-1]",), "depends on no state"),
    ],
)
def test_bad_delays_are_refused(functions, message):
    with pytest.raises(ConfigError, match=message.replace("(", r"\(")):
        Lifting(STATES, functions, ("phase",), INPUTS)


@pytest.mark.parametrize(
    ("inputs", "functions", "message"),
    [
        (INPUTS, ("position**2",), "depends on no input"),
        (INPUTS, ("voltage",), "is 'voltage' itself"),
        (INPUTS, ("voltage*position", "position*voltage"), "repeat"),
        ((), ("voltage*position",), "unknown name 'voltage'"),
        (("position",), (), "rename"),
    ],
)
def test_bad_input_functions_are_refused(inputs, functions, message):
    with pytest.raises(ConfigError, match=message):
        Lifting(STATES, (), (), inputs, functions)


def test_an_input_that_rests_in_all_recordings_is_named():
    x, u = recording()
    still, linear = u * [1.0, 0.0], Lifting(STATES)
    one = Factor.stack([reduce_episode(x, u, linear), reduce_episode(x, still, linear)])
    require_excitation(one, INPUTS, "load")
    silent = Factor.stack([reduce_episode(x, still, linear)] * 2)
    with pytest.raises(IdentificationError, match=r"Input 'target' is zero .* \(load\); drop the channel"):
        require_excitation(silent, INPUTS, "load")
