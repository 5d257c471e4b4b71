"""Estimates that diverge spoil no other spectrum; observers that share a model share a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kros.evaluate.errors import errors_of
from kros.evaluate.held_out import alike
from kros.lifting import Lifting
from kros.observer import Observer

DT = 1e-3


def test_a_diverged_estimate_spoils_no_other_spectrum() -> None:
    truth, estimate = np.zeros((2000, 2, 1)), np.random.default_rng(3).normal(size=(2000, 2, 1))
    estimate[1000:, 0] = np.inf
    band = 10.0, 100.0
    alone = errors_of(estimate[:, 1:], truth[:, 1:], np.array([2000]), DT, band)["gearbox_band_power"]
    both = errors_of(estimate, truth, np.array([2000, 2000]), DT, band)["gearbox_band_power"]
    assert not np.isfinite(both[0]).any()
    np.testing.assert_allclose(both[1:], alone, rtol=1e-12)


def test_observers_of_one_model_share_a_run() -> None:
    lifting = Lifting(("x", "v"))
    first = Observer.open_loop("a", lifting, np.eye(2), np.ones((2, 1)), (0,), ("u",), DT)
    names = [
        [o.name for o in g] for g in alike([first, replace(first, name="b", measured=(1,)), replace(first, name="c")])
    ]
    assert names == [["a", "c"], ["b"]]
    assert [len(g) for g in alike([first] * 20)] == [8, 8, 4]
