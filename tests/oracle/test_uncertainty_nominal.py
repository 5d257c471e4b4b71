"""The pruned search for the nominal finds what visiting all pairs, one by one and from the definition, finds."""

from __future__ import annotations

import numpy as np
import pytest
from forms import residual_of

from kros.core import StateSpace
from kros.core.errors import DataError
from kros.uncertainty import Form, choose_nominal

FORMS = list(Form)
SHAPES = [(4, 2), (2, 4), (2, 2), (1, 1), (3, 3), (1, 3)]


def random_responses(n_units: int, n_freqs: int, shape: tuple[int, int], seed: int) -> np.ndarray:
    """No structure at all: residuals of any pair are as large as those of any other."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n_units, n_freqs, *shape)) + 1j * rng.normal(size=(n_units, n_freqs, *shape))


def lags(n_units: int, n_freqs: int, seed: int) -> np.ndarray:
    """Responses of coupled lags with four outputs and two inputs whose poles and gains are spread, with two units far out."""
    rng = np.random.default_rng(seed)
    spread = 0.05 * rng.normal(size=(n_units, 1, 1))
    spread[:2] *= 4
    poles = np.exp(-2e-3 * np.pi * np.array([1.0, 5.0, 20.0, 80.0]) * (1 + spread))
    mixing = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    A = mixing @ (poles.swapaxes(1, 2) * np.eye(4)) @ np.linalg.inv(mixing)
    B = (np.eye(4) - A) @ (rng.normal(size=(4, 2)) * (1 + 0.05 * rng.normal(size=(n_units, 4, 2))))
    system = StateSpace(A, B, np.broadcast_to(np.eye(4), A.shape), np.zeros(B.shape), 1e-3)
    return system.frequency_response(np.geomspace(0.1, 500.0, n_freqs))


def slow_bounds(form: Form, candidates: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Bounds pair by pair from the table of the forms."""
    return np.array(
        [np.max([np.linalg.norm(residual_of(form, g, h), 2, axis=(-2, -1)) for h in units], axis=0) for g in candidates]
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", SHAPES)
def test_search_equals_brute_force_where_no_candidate_is_much_better(form: Form, shape: tuple[int, int]) -> None:
    for seed in range(3):
        G = random_responses(9, 20, shape, seed)
        slow = slow_bounds(form, G, G)
        peak = choose_nominal(G, form)
        assert peak.index == np.argmin(slow.max(axis=1))
        np.testing.assert_allclose(peak.bound, slow[peak.index], rtol=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_search_equals_all_pairs_of_a_population(form: Form) -> None:
    G = lags(30, 6, 3)
    slow = slow_bounds(form, G, G)
    found = choose_nominal(G, form)
    assert found.index == np.argmin(slow.max(axis=1))
    np.testing.assert_allclose(found.bound, slow[found.index], rtol=1e-9)


def test_ties_go_to_the_first_of_the_best() -> None:
    G = lags(7, 12, 5)
    best = choose_nominal(G, "additive").index
    order = [*np.delete(np.arange(7), best), best, best]
    for moved in (order, order[::-1]):
        twice = choose_nominal(G[moved], "additive")
        assert twice.index == moved.index(best)
    same = np.repeat(G[:1], 5, axis=0)
    for form in FORMS:
        assert choose_nominal(same, form).index == 0


def test_what_cannot_be_searched_is_refused() -> None:
    G = random_responses(3, 5, (2, 2), 10)
    G[1, 2, 0, 0] = np.nan
    with pytest.raises(DataError, match="unit '1' has NaN"):
        choose_nominal(G, "additive")
