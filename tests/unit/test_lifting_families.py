"""Families: the formulas that they write, that their values are those of the definitions, and what they refuse."""

import numpy as np
import pytest

from kros.core.errors import ConfigError
from kros.lifting import Lifting, delays, harmonics, kmeans_centres, polynomials, radial
from kros.lifting.families import check_family, family, number

STATES = ("position", "velocity", "current")
RNG = np.random.default_rng(0)
X = RNG.normal(size=(200, 3))


def values(functions, parameters=None):
    lifting = Lifting(STATES, functions, tuple(parameters or ()))
    return lifting.lift(X, parameters)[:, 3:]


@pytest.mark.parametrize(
    "value", [0.1, 1 / 3, -2.5e-300, 1e22, 123456789.0, 5e-324, -0.0, np.pi, 1e15, np.nextafter(1, 2)]
)
def test_numbers_survive_their_text(value):
    found = float(Lifting(("x",), (f"x*({number(value)})",)).lift([[1.0]])[0, 1]) if value else float(number(value))
    assert found == value


def test_harmonics_of_an_angle_with_a_phase():
    functions = harmonics("position", 100, [1, 3], "phase")
    assert functions == (
        "sin(100*position + phase)",
        "cos(100*position + phase)",
        "sin(3*(100*position + phase))",
        "cos(3*(100*position + phase))",
    )
    angle = 100 * X[:, 0] + 0.7
    expected = [np.sin(angle), np.cos(angle), np.sin(3 * angle), np.cos(3 * angle)]
    np.testing.assert_allclose(values(functions, {"phase": 0.7}), np.transpose(expected), atol=1e-11)
    separation = Lifting(STATES, functions, ("phase",)).separation
    assert len(separation.basis) == 4


def test_families_work_on_the_values_of_other_functions():
    functions = polynomials(["sin(position)", "velocity"], 2)
    assert functions == ("(sin(position))**2", "(sin(position))*velocity", "velocity**2")
    s, v = np.sin(X[:, 0]), X[:, 1]
    np.testing.assert_allclose(values(functions), np.stack([s * s, s * v, v * v], axis=1), rtol=1e-13)
    (bump,) = radial(["position - velocity"], [[0.25]], 0.5)
    np.testing.assert_allclose(values((bump,))[:, 0], np.exp(-(((X[:, 0] - v - 0.25) / 0.5) ** 2) / 2), rtol=1e-12)


def test_kmeans_finds_separate_clusters_in_any_units():
    rng = np.random.default_rng(5)
    means = np.array([[0, 0], [1, 1000], [-1, 2000.0]])
    data = np.concatenate([m + rng.normal(size=(100, 2)) * [0.01, 10] for m in means])
    found = kmeans_centres(data, 3, 0)
    np.testing.assert_allclose(found[np.argsort(found[:, 1])], means[[0, 1, 2]], atol=5)
    np.testing.assert_allclose(np.sort(found[:, 0]), [-1, 0, 1], atol=0.005)
    np.testing.assert_array_equal(found, kmeans_centres(data, 3, 0))


def clustered(names=("a",), n=3, seed=0):
    return {"kind": "radial", "names": names, "centres": {"kind": "kmeans", "n": n, "seed": seed}, "length": 1}


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: harmonics("position", 0, [1]), "ratio: .* should not be zero"),
        (lambda: harmonics("position", 1, [0]), "orders: .* equal to 1"),
        (lambda: harmonics("position", 1, [1, 1]), "give each once"),
        (lambda: harmonics("position", np.inf, [1]), "finite"),
        (lambda: polynomials("position", 2), "names: input should be a valid tuple"),
        (lambda: polynomials(["a"], 1), "degree: .* equal to 2"),
        (lambda: radial(["a", "b"], [[0.0]], 1.0), r"shape \(n, 2\), found shape \(1, 1\)"),
        (lambda: radial(["a"], [[0.0]], 0.0), "length: input should be greater than 0"),
        (lambda: radial(["a"], [[0.0]], [1.0, 2.0]), "one for each quantity"),
        (lambda: radial(["a"], [[np.nan]], 1.0), "finite"),
        (lambda: delays(["a"], 0), "depth: .* equal to 1"),
        (lambda: delays(["a"], 1001), "depth: .* equal to 1000"),
        (lambda: delays(["sin(a)"], 1), "only states and inputs have earlier values"),
        (lambda: kmeans_centres(np.zeros((50, 2)), 2, 0), "have 1 clusters"),
        (lambda: Lifting(("a",), (*polynomials(["a"], 2), "a**2")), "functions repeat one of them"),
        (lambda: family({"kind": "wavelets"}), "known are harmonics"),
        (lambda: family({"kind": "delays", "names": ["a"], "depths": 2}), "depth: missing .*; depths: unexpected"),
        (lambda: family(clustered() | {"centres": {"kind": "spiral"}}), "known are kmeans"),
        (lambda: family(clustered()), "data: missing"),
        (lambda: family(clustered() | {"centres": "here"}), "could not convert"),
        (lambda: check_family(clustered(names=3)), "names: input should be a valid tuple"),
        (lambda: check_family(clustered(seed=-1)), "seed: .* equal to 0"),
        (lambda: radial(["a"], [[10**400]], 1.0), "too large"),
        (lambda: Lifting(("a",), ("+".join(["sin(1.2345678*a)"] * 200),)), "at most 2000"),
    ],
)
def test_what_cannot_be_built_is_refused(build, message):
    with pytest.raises(ConfigError, match=message):
        build()


def test_families_as_tables():
    table = {"kind": "radial", "names": ["position"], "centres": [[0], [1]], "length": 0.5}
    assert family(table) == radial(["position"], [[0], [1]], 0.5)
    asked = []

    def sample(names):
        asked.append(names)
        return np.array([[0.0], [0.0], [1.0], [1.0]])

    found = family({**table, "centres": {"kind": "kmeans", "n": 2, "seed": 0}}, sample)
    assert (set(found), asked) == (set(radial(["position"], [[0], [1]], 0.5)), [("position",)])
