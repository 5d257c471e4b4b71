"""Diagonal weights: sections against finite differences and their systems, joint fits against data that can be represented exactly."""

from __future__ import annotations

import numpy as np
from residuals import of_function

from kros.core import StateSpace
from kros.uncertainty.weights.cover import NEPER_DB
from kros.uncertainty.weights.fit import fit_weight
from kros.uncertainty.weights.sections import Sections

DT = 1e-3
FREQS = np.geomspace(5e-2, 500.0, 150)
W = 1j * np.tan(np.pi * np.minimum(FREQS, 499.999) * DT)


def some_sections() -> Sections:
    rng = np.random.default_rng(0)
    pair = np.array([1, 1, 1, 1, 0, 0], bool)
    return Sections(
        rng.normal(size=2), np.array([0, 0, 1, 1, 1, 1]), np.tile([1.0, -1.0], 3), pair, *rng.normal(size=(2, 6))
    )


def differences(function, size: int) -> np.ndarray:
    return np.array([(function(e) - function(-e)) / 2e-6 for e in 1e-6 * np.eye(size)])


def test_slopes_are_those_of_finite_differences() -> None:
    sections, tau = some_sections(), np.geomspace(1e-3, 1e3, 40)
    owner = sections.owner
    far = (-50.0, 50.0)
    slope = differences(
        lambda x: sections.at(sections.parameters + x, far).logs(tau)[owner].ravel(), len(owner)
    ).reshape(len(owner), len(owner), 40)
    np.testing.assert_allclose(np.einsum("iif->if", slope), sections.slopes(tau), atol=1e-8)


def test_systems_have_the_magnitudes_of_the_sections_and_are_stable_with_their_inverses() -> None:
    sections = some_sections()
    for system, logs in zip(sections.systems(DT), sections.logs(np.abs(W) ** 2), strict=True):
        np.testing.assert_allclose(np.log(np.abs(system.frequency_response(FREQS)[:-1, 0, 0])), logs[:-1], atol=1e-10)
        assert system.is_stable()
        assert StateSpace(system.A - system.B @ system.C / system.D, system.B, system.C, system.D, DT).is_stable()
    assert sections.orders.tolist() == [2, 3]


def lags_and_leads(freqs: np.ndarray) -> np.ndarray:
    """Diagonal residuals of one unit whose moduli are of order two and one."""
    w = 1j * np.tan(np.pi * np.minimum(np.asarray(freqs), 500 - 1e-9) * DT)
    first = (w + 3e-3) * (w + 0.3) / ((w + 3e-2) * (w + 2.0))
    return np.einsum("if,ij->fij", np.stack([first, 0.5 * (w + 0.1) / (w + 0.01)]), np.eye(2))[None]


def test_diagonal_residuals_that_can_be_represented_are_met_with_lower_orders() -> None:
    weight, cover = fit_weight(of_function(lags_and_leads), FREQS, DT, 4, 0.3)
    assert weight.overbound_db_max <= 0.3
    assert sum(weight.left_orders) + sum(weight.right_orders) <= 4  # three would do
    used = weight.magnitudes(FREQS)
    used = used.left[:, :, None] * used.right[:, None, :]
    exact = np.abs(np.einsum("kfii->fi", lags_and_leads(FREQS)))
    assert (np.einsum("fii->fi", used) >= exact * (1 - 1e-9)).all()
    np.testing.assert_allclose(cover.cost() * NEPER_DB, 20 * np.log10(exact).mean(axis=1), atol=0.02)


def test_higher_orders_are_taken_where_four_are_not_enough() -> None:
    freqs = np.geomspace(5e-2, 500.0, 60)

    def peaks(at: np.ndarray) -> np.ndarray:
        w = 1j * np.tan(np.pi * np.minimum(at, 499.999) * DT)
        return np.prod([(w**2 + 2 * a * w + a**2) / (w**2 + 0.5 * a * w + a**2) for a in (2e-3, 3e-2, 0.4)], axis=0)[
            None, :, None, None
        ]

    four, _ = fit_weight(of_function(peaks), freqs, DT, 4, 1.0)
    six, _ = fit_weight(of_function(peaks), freqs, DT, 6, 1.0)
    assert max(four.left_orders) <= 4 < max(six.left_orders) <= 6
    assert six.overbound_db_max < four.overbound_db_max
