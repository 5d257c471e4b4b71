"""Liftings of channels that are divided by sizes: the same functions, written as before."""

from __future__ import annotations

import pickle

import numpy as np

from kros.lifting import Lifting
from kros.observer import Observer

FULL = Lifting(
    ("position", "velocity"),
    ("sin(100*position + phase)", "velocity*abs(velocity)", "position[-1]*voltage[-2]"),
    ("phase",),
    ("voltage",),
    ("voltage*velocity",),
)
SIZES = {
    "position": 2e9,
    "velocity": 3e-9,
    "voltage": 5e4,
    "velocity*abs(velocity)": 7e-18,
    "position[-1]*voltage[-2]": 1e14,
    "voltage*velocity": 2e-4,
}


def test_values_and_slopes_are_those_of_the_formulas_over_their_sizes():
    rng, scaled = np.random.default_rng(0), FULL.in_sizes(SIZES)
    window, u = rng.normal(size=(50, len(FULL.window.names))), rng.normal(size=(50, 1))
    by = np.array([SIZES[name.partition("[")[0]] for name in FULL.window.names])
    window[:, [0, 2]] *= 1e-9  # so that the sine is not aliased by rounding
    out, into = scaled.sizes_of(FULL.names), scaled.sizes_of(("voltage", "voltage*velocity"))
    values, u_recorded = {"phase": 0.4}, u * SIZES["voltage"]
    np.testing.assert_allclose(scaled.lift(window, values) * out, FULL.lift(window * by, values), rtol=1e-9)
    np.testing.assert_allclose(
        scaled.lift_inputs(u, window, values) * into, FULL.lift_inputs(u_recorded, window * by, values), rtol=1e-12
    )
    recorded = FULL.slopes(window * by, values) * by
    np.testing.assert_allclose(scaled.slopes(window, values) * out[2:, None], recorded, rtol=1e-6)


def test_sizes_travel_between_processes_and_into_files(tmp_path):
    scaled, path = FULL.in_sizes(SIZES), tmp_path / "observer.json"
    assert pickle.loads(pickle.dumps(scaled)) == scaled
    for lifting in (scaled, FULL):
        n, m = lifting.n_lifted, len(lifting.inputs) + len(lifting.input_functions)
        Observer.open_loop("o", lifting, np.eye(n), np.ones((n, m)), (0,), lifting.inputs, 0.01).save(path)
        assert Observer.load(path).lifting == lifting
    assert "sizes" not in path.read_text()
