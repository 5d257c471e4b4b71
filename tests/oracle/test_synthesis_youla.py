"""The Youla program against Riccati optima, against published theory of both ends, and against dense frequency grids."""

import numpy as np
import pytest
from youla import Family, youla_bound

from kros.core import ConfigError, SynthesisError, h2_norm, hinf_norm
from kros.synthesis import GeneralizedPlant, h2, hinf
from kros.synthesis.mixed_norms.channels import part
from kros.synthesis.mixed_norms.lower_bounds import hinf_lower_bound, mixed_lower_bound


def random_plant(seed, n=3, radius=0.7, split=None):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    shapes = ((n, 3), (n, 2), (4, n), (2, n), (4, 3), (4, 2), (2, 3))
    parts = [rng.standard_normal(shape) for shape in shapes]
    return GeneralizedPlant(A, *parts, 0.1 * rng.standard_normal((2, 2)), 1.0, *(split or (None, None)))


@pytest.mark.parametrize(("seed", "centre"), [(0, "open_loop"), (1, "open_loop"), (2, None), (0, "h2")])
def test_without_a_bound_it_is_the_riccati_optimum(seed, centre):
    plant = random_plant(seed)
    found, optimum = youla_bound(plant, 16, "h2", centre=centre), h2(plant)
    assert found.converged
    assert found.value == pytest.approx(optimum.h2_norm, rel=1e-6)
    assert found.value >= optimum.h2_norm * (1 - 1e-9)
    assert found.h2_norm == pytest.approx(h2_norm(plant.close(found.controller)))


@pytest.mark.parametrize("centre", ["open_loop", "h2"])
def test_energy_of_any_filter_is_the_lyapunov_norm(centre):
    plant = random_plant(3, split=(2, 2))
    family = Family.around_open_loop(plant) if centre == "open_loop" else Family.around_h2(_more_outputs(plant))
    q = np.random.default_rng(0).standard_normal((4, 2, 2))
    H, g, constant = family.energy(4)
    closed = family.plant.close(family.controller(q))
    predicted = q.ravel() @ H @ q.ravel() + 2 * g @ q.ravel() + constant
    assert h2_norm(part(family.plant, closed, 1)) ** 2 == pytest.approx(predicted, rel=1e-9)


def _more_outputs(plant):
    """The same plant with all disturbances and three outputs in channel 1, so that it is regular."""
    return GeneralizedPlant(*(getattr(plant, x) for x in ("A", "B1", "B2", "C1", "C2", "D11", "D12", "D21", "D22")), 1.0, 3, 3)


def scalar_plant(a=0.7, size=0.5):
    """One state, w = (w1, noise | w2), z = (x, u | x)."""
    B1, C1 = [[1.0, 0.0, size]], [[1.0], [0.0], [size]]
    return GeneralizedPlant([[a]], B1, [[1.0]], C1, [[1.0]], np.zeros((3, 3)), [[0], [0.5], [0]], [[0, 0.5, 0]], [[0.0]], 1.0, 2, 2)


def test_hinf_end_agrees_with_the_riccati_synthesis():
    plant = random_plant(1, n=2)
    found, optimum = youla_bound(plant, 8, "hinf", max_taps=16), hinf(plant)
    assert found.value == pytest.approx(optimum.hinf_norm, rel=1e-3)
    assert found.value >= optimum.lower_bound
    assert found.value == pytest.approx(hinf_norm(plant.close(found.controller)))


def test_bounds_close_on_each_other_and_order():
    plant = scalar_plant()
    free = h2(plant.channel(plant.rows(1), plant.columns(1)))
    peak = hinf_norm(part(plant, plant.close(free.controller), 2))
    least = hinf_lower_bound(plant)
    assert least <= youla_bound(plant, 8, "hinf", max_taps=16).value <= least * 1.02
    previous = np.inf
    for gamma in np.linspace(least * 1.05, peak * 1.02, 3):
        upper = youla_bound(plant, 8, "mixed", gamma)
        lower = mixed_lower_bound(plant, gamma, upper.value)
        assert free.h2_norm * (1 - 1e-9) <= lower <= upper.value * (1 + 1e-9) <= previous * (1 + 1e-6)
        assert upper.value <= lower * 1.01
        assert upper.hinf_norm < gamma
        previous = upper.value
    assert previous == pytest.approx(free.h2_norm, rel=1e-6)


def test_unstable_plants_have_a_family_too():
    plant = scalar_plant(a=1.5)
    free = h2(plant.channel(plant.rows(1), plant.columns(1)))
    assert youla_bound(plant, 4, "h2").value == pytest.approx(free.h2_norm, rel=1e-9)
    with pytest.raises(SynthesisError, match=r"spectral radius 1\.5.*centre = 'h2'"):
        youla_bound(plant, centre="open_loop")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"objective": "mixed"}, ConfigError, "hinf_bound = None should be positive"),
        ({"objective": "l1"}, ConfigError, "'h2', 'mixed' or 'hinf'"),
        ({"taps": 0}, ConfigError, "taps = 0"),
        ({"centre": "elsewhere"}, ConfigError, "'open_loop' or 'h2'"),
        ({"objective": "mixed", "hinf_bound": 1e-3, "max_taps": 8}, SynthesisError, "infeasible.*raise hinf_bound"),
    ],
)
def test_bad_questions_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        youla_bound(scalar_plant(), **options)
