"""Pipelines of pykoop as models of kros: both predict the same, and what cannot be taken over is named."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from kros.core import ConfigError, DataError, DimensionError, IdentificationError
from kros.data import Channel, EpisodeKey, Role, from_arrays
from kros.identify import ModelSet
from kros.interop import AdoptedModel, KoopmanRegressor, from_pykoop, models_from_pykoop
from kros.lifting import Lifting
from kros.uncertainty import quantify_systems

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import pykoop
    from sklearn import preprocessing


def recording(offset: float = 0.0, gain: float = 1.0, seed: int = 0) -> np.ndarray:
    """Three episodes of a nonlinear system with two states and one input, in pykoop's layout."""
    rng = np.random.default_rng(seed)
    rows = []
    for episode in range(3):
        x = 0.5 * rng.normal(size=2)
        for u in rng.normal(size=200):
            rows.append([episode, *(x + offset), u + 2 * offset])
            x = np.array([0.8 * x[0] + 0.1 * x[1] - 0.05 * x[0] ** 2 + 0.1 * u, gain * 0.7 * x[1] - 0.1 * np.sin(x[0]) + 0.2 * u])
    return np.array(rows)


def on_states(*functions: Any) -> tuple[str, Any]:
    return ("split", pykoop.SplitPipeline(lifting_functions_state=[(f"f{i}", f) for i, f in enumerate(functions)]))


def scaler(transformer: Any) -> tuple[str, Any]:
    return ("scale", pykoop.SkLearnLiftingFn(transformer))


def fitted(functions: list[Any], X: np.ndarray, alpha: float = 1e-3, n_inputs: int = 1) -> Any:
    pipeline = pykoop.KoopmanPipeline(lifting_functions=functions, regressor=pykoop.Edmd(alpha=alpha))
    return pipeline.fit(X, n_inputs=n_inputs, episode_feature=True)


POLYNOMIAL = pykoop.PolynomialLiftingFn(order=2)
CENTRES = pykoop.QmcCenters(n_centers=3, random_state=0)
FOURIER = {"n_components": 4, "random_state": 0}
PIPELINES = {
    "linear": [],
    "polynomial": [on_states(pykoop.PolynomialLiftingFn(order=3))],
    "polynomial twice": [on_states(POLYNOMIAL, POLYNOMIAL)],
    "standard scaler": [scaler(preprocessing.StandardScaler()), on_states(POLYNOMIAL)],
    "standard scaler behind": [on_states(POLYNOMIAL), scaler(preprocessing.StandardScaler())],
    "scaler without mean": [scaler(preprocessing.StandardScaler(with_mean=False)), on_states(POLYNOMIAL)],
    "scaler without scale": [scaler(preprocessing.StandardScaler(with_std=False)), on_states(POLYNOMIAL)],
    "two scalers": [
        scaler(preprocessing.MinMaxScaler((-1, 1))),
        on_states(POLYNOMIAL),
        ("behind", pykoop.SkLearnLiftingFn(preprocessing.MaxAbsScaler())),
    ],
    "minmax scaler": [scaler(preprocessing.MinMaxScaler()), on_states(POLYNOMIAL)],
    "maxabs scaler": [scaler(preprocessing.MaxAbsScaler()), on_states(POLYNOMIAL)],
    "robust scaler": [scaler(preprocessing.RobustScaler()), on_states(POLYNOMIAL)],
    "robust scaler without centre": [scaler(preprocessing.RobustScaler(with_centering=False, with_scaling=False)), on_states(POLYNOMIAL)],
    "constant": [on_states(POLYNOMIAL), ("constant", pykoop.ConstantLiftingFn())],
    "nested": [("inner", pykoop.KoopmanPipeline([on_states(POLYNOMIAL)], pykoop.Edmd()))],
    "inputs scaled": [("split", pykoop.SplitPipeline([("p", POLYNOMIAL)], [scaler(preprocessing.StandardScaler())]))],
    **{
        f"rbf {shape}": [on_states(pykoop.RbfLiftingFn(rbf=shape, centers=CENTRES, shape=0.7))]
        for shape in ("exponential", "gaussian", "multiquadric", "inverse_quadratic", "inverse_multiquadric", "thin_plate")
    },
    "fourier": [on_states(pykoop.KernelApproxLiftingFn(pykoop.RandomFourierKernelApprox(**FOURIER)))],
    "fourier pairs": [on_states(pykoop.KernelApproxLiftingFn(pykoop.RandomFourierKernelApprox(method="weight_only", **FOURIER)))],
}
LIFTED_INPUTS = {
    "polynomial of inputs": [("p", POLYNOMIAL)],
    "bilinear": [scaler(preprocessing.StandardScaler()), ("b", pykoop.BilinearInputLiftingFn())],
    "rbf of inputs": [("r", pykoop.RbfLiftingFn(centers=CENTRES))],
}


def agrees(functions: list[Any], offset: float) -> AdoptedModel:
    """Adopt a pipeline and compare free runs along a recording that it has not seen."""
    pipeline = fitted(functions, recording(offset))
    model = from_pykoop(pipeline)
    X = recording(offset, seed=5)
    X = X[X[:, 0] == 0]
    theirs = pipeline.predict(X)[:, 1:]
    assert np.allclose(model.predict(X[:, 1:3], X[:, 3:]), theirs, rtol=1e-10, atol=1e-10)
    run = pipeline.predict_trajectory(X[:20])[:, 1:]
    assert np.allclose(model.free_run(X[0, 1:3], X[:20, 3:]), run, rtol=1e-9, atol=1e-9)
    assert model.disagreement < 1e-12
    return model


@pytest.mark.parametrize("offset", [0.0, 3.0])
@pytest.mark.parametrize("functions", PIPELINES.values(), ids=PIPELINES.keys())
def test_both_predict_the_same(functions: list[Any], offset: float) -> None:
    agrees(functions, offset)


@pytest.mark.parametrize("functions", LIFTED_INPUTS.values(), ids=LIFTED_INPUTS.keys())
def test_both_predict_the_same_with_lifted_inputs(functions: list[Any]) -> None:
    agrees(functions, 1.0)


DELAYS = {
    "both": [("late", pykoop.DelayLiftingFn(2, 2))],
    "states": [("late", pykoop.DelayLiftingFn(2, 0))],
    "inputs": [("late", pykoop.DelayLiftingFn(0, 1))],
    "behind a scaler": [scaler(preprocessing.StandardScaler()), ("late", pykoop.DelayLiftingFn(1, 2))],
    "behind a polynomial": [on_states(POLYNOMIAL), ("late", pykoop.DelayLiftingFn(1, 1))],
    "before a polynomial": [("late", pykoop.DelayLiftingFn(1, 1)), on_states(POLYNOMIAL)],
    "of delays": [("late", pykoop.DelayLiftingFn(1, 0)), ("later", pykoop.DelayLiftingFn(1, 1))],
    "of one kind each": [("split", pykoop.SplitPipeline([("x", pykoop.DelayLiftingFn(1, 1))], [("u", pykoop.DelayLiftingFn(2, 2))]))],
}


@pytest.mark.parametrize("offset", [0.0, 3.0])
@pytest.mark.parametrize("functions", DELAYS.values(), ids=DELAYS.keys())
def test_both_run_freely_alike_with_delays(functions: list[Any], offset: float) -> None:
    pipeline = fitted(functions, recording(offset))
    model = from_pykoop(pipeline)
    X = recording(offset, seed=5)[:14]  # few: fitted to so little, a polynomial of delays diverges
    theirs = pipeline.predict_trajectory(X)[:, 1:]
    start = pipeline.min_samples_
    ours = model.free_run(X[start - model.lifting.history - 1 : start, 1:3], X[start - model.lifting.history - 1 :, 3:])
    assert np.allclose(ours[-9:], theirs[-9:], rtol=1e-9, atol=1e-9)
    assert model.disagreement < 1e-12


@pytest.mark.parametrize("alpha", [0.0, 0.3])
def test_the_estimator_and_pykoop_identify_the_same(alpha: float) -> None:
    X = recording()
    model = KoopmanRegressor(["x0**2", "x0*x1", "x1**2"], n_inputs=1, episode_feature=True, alpha=alpha).fit(X)
    coefficients = fitted([on_states(POLYNOMIAL)], X, alpha).regressor_.coef_.T
    assert np.allclose(np.concatenate([model.A_, model.B_], axis=1), coefficients, rtol=1e-9, atol=1e-9)
    adopted = from_pykoop(fitted([on_states(POLYNOMIAL)], X, alpha))
    assert np.allclose(model.predict(X), adopted.predict(X[:, 1:3], X[:, 3:]), rtol=1e-9, atol=1e-9)


def test_delays_are_formulas_of_earlier_values() -> None:
    model = from_pykoop(fitted(DELAYS["both"], recording()), states=["angle", "rate"], inputs=["voltage"])
    assert model.lifting.functions == ("angle[-1]", "rate[-1]", "angle[-2]", "rate[-2]")
    assert model.lifting.input_functions == ("voltage[-1]", "voltage[-2]")


def test_formulas_are_free_of_the_scaler() -> None:
    model = agrees(PIPELINES["standard scaler"], 3.0)
    X = recording(3.0)
    assert model.lifting == Lifting(("x0", "x1"), ("x0**2", "x0*x1", "x1**2"))
    assert np.allclose(model.state_offset, X[:, 1:3].mean(axis=0), rtol=1e-12)
    assert np.allclose(model.input_offset, X[:, 3:].mean(axis=0), rtol=1e-12)


def test_a_linear_system_without_inputs_gives_its_matrix() -> None:
    A = np.array([[0.9, 0.2], [-0.1, 0.8]])
    x = [np.array([1.0, -0.5])]
    for _ in range(30):
        x.append(A @ x[-1])
    model = from_pykoop(fitted([], np.column_stack([np.zeros(31), x]), alpha=0, n_inputs=0), states=["angle", "rate"])
    assert np.allclose(model.A, A, atol=1e-9)
    assert model.system(0.01).n_inputs == 0
    assert np.allclose(model.predict(x[0]), x[1], atol=1e-9)
    assert model.lifting.states == ("angle", "rate")


def test_names_come_from_the_frame() -> None:
    import pandas as pd

    frame = pd.DataFrame(recording(), columns=["episode", "angle", "rate", "voltage"])
    model = from_pykoop(fitted([on_states(POLYNOMIAL)], frame))
    assert (model.lifting.functions, model.inputs) == (("angle**2", "angle*rate", "rate**2"), ("voltage",))
    assert from_pykoop(fitted([], frame), states=["p", "q"], inputs=["r"]).lifting.states == ("p", "q")


def refused(functions: list[Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        from_pykoop(fitted(functions, recording()))


class Cube(pykoop.PolynomialLiftingFn):  # type: ignore[misc]
    """A custom function, known to pykoop alone."""


def test_functions_without_a_formula_are_named() -> None:
    refused([on_states(Cube(order=2))], ConfigError, r"lifting function 'split/f0' \(Cube\)")
    refused([scaler(preprocessing.QuantileTransformer(n_quantiles=10))], ConfigError, "'scale' wraps QuantileTransformer")
    refused([scaler(preprocessing.MinMaxScaler(clip=True))], ConfigError, "MinMaxScaler with clip = True")
    refused([on_states(pykoop.RbfLiftingFn(rbf="bump_function", centers=CENTRES))], ConfigError, "'bump_function', which has no formula")
    binning = pykoop.KernelApproxLiftingFn(pykoop.RandomBinningKernelApprox(n_components=2, random_state=0))
    refused([on_states(binning)], ConfigError, "wraps RandomBinningKernelApprox")


def test_a_pipeline_that_is_not_one_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"needs a pykoop\.KoopmanPipeline, found Edmd"):
        from_pykoop(pykoop.Edmd())
    with pytest.raises(IdentificationError, match="not fitted"):
        from_pykoop(pykoop.KoopmanPipeline(regressor=pykoop.Edmd()))


@pytest.mark.parametrize("states", [["a"], ["a", "a"], ["a", "b c"], ["a", "lambda"], "ab"])
def test_names_that_do_not_fit_are_refused(states: Any) -> None:
    with pytest.raises(ConfigError, match="2 states and 1 inputs"):
        from_pykoop(fitted([], recording()), states=states)


def test_a_drift_that_no_shift_removes_is_refused() -> None:
    k = np.arange(50.0)
    X = np.column_stack([np.zeros(50), k])  # x+ = x + 1
    pipeline = fitted([("constant", pykoop.ConstantLiftingFn())], X, alpha=0, n_inputs=0)
    pipeline.regressor_.coef_ = np.array([[1.0, 0.0], [1.0, 1.0]])
    with pytest.raises(IdentificationError, match=r"adds a constant of 1 .* no shift"):
        from_pykoop(pipeline)


def test_a_disagreement_is_refused() -> None:
    pipeline = fitted([on_states(POLYNOMIAL)], recording())
    transform = pipeline.transform
    pipeline.transform = lambda X: transform(X) * (1 + 1e-6)
    with pytest.raises(IdentificationError, match=r"differ from pykoop's by 1\.0e-06"):
        from_pykoop(pipeline)


def test_inputs_are_needed_where_there_are_some() -> None:
    with pytest.raises(DimensionError, match=r"inputs \('u0',\)"):
        from_pykoop(fitted([], recording())).predict(np.zeros((4, 2)))


CHANNELS = (Channel("angle", Role.STATE, measured=True), Channel("rate", Role.STATE), Channel("voltage", Role.INPUT))


def batch(functions: list[Any]) -> tuple[dict[str, Any], Any]:
    """Pipelines of four units, and the recordings that they were fitted to."""
    X = {f"unit{i}": recording(gain=1 + 0.05 * i, seed=i) for i in range(4)}
    episodes = {EpisodeKey(u, "default", str(e)): x[x[:, 0] == e, 1:] for u, x in X.items() for e in range(3)}
    return {u: fitted(functions, x) for u, x in X.items()}, from_arrays(episodes, CHANNELS, 0.01)


def test_one_pipeline_for_each_unit_gives_the_models_of_a_population() -> None:
    pipelines, population = batch([on_states(POLYNOMIAL)])
    models = models_from_pykoop(pipelines, population)
    assert isinstance(models, ModelSet)
    assert models.lifting.functions == ("angle**2", "angle*rate", "rate**2")
    assert models.status == ("ok",) * 4
    for i, unit in enumerate(models.unit_ids):
        X = np.concatenate([population.read(key) for key in population.keys(unit)])
        coefficients = pipelines[unit].regressor_.coef_.T
        assert np.allclose(np.concatenate([models.A[i], models.B[i]], axis=1), coefficients, rtol=1e-12)
        lifted = models.lifting.lift(X[:, :2])
        assert np.all(np.abs(lifted).max(axis=0) <= models.output_scale)
    assert quantify_systems(models, form="additive").cover_max <= 1


def test_lifted_inputs_are_inputs_of_the_models() -> None:
    pipelines, population = batch([("b", pykoop.BilinearInputLiftingFn())])
    models = models_from_pykoop(pipelines, population)
    assert models.inputs == ("voltage", "angle*voltage", "rate*voltage")
    assert (models.B.shape, models.input_scale.shape) == ((4, 2, 3), (3,))


def test_delays_of_a_population() -> None:
    pipelines, population = batch(DELAYS["both"])
    models = models_from_pykoop(pipelines, population)
    assert models.inputs == ("voltage", "voltage[-1]", "voltage[-2]")
    assert np.array_equal(models.output_scale[:2], models.output_scale[2:4])


def test_a_population_needs_one_lifting_without_offsets_and_known_units() -> None:
    pipelines, population = batch([scaler(preprocessing.StandardScaler())])
    with pytest.raises(ConfigError, match=r"'unit0', .* are centred"):
        models_from_pykoop(pipelines, population)
    pipelines, population = batch([on_states(POLYNOMIAL)])
    linear, _ = batch([])
    with pytest.raises(ConfigError, match=r"units \['unit2'\] have other functions"):
        models_from_pykoop({**pipelines, "unit2": linear["unit2"]}, population)
    with pytest.raises(DataError, match=r"no episodes of \['unit9'\]"):
        models_from_pykoop({"unit9": linear["unit2"]}, population)
