"""The functions of the short way by themselves: what they take, what they refuse, and what follows from formulas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import kros
from kros.core.errors import ConfigError, DataError, DimensionError, SynthesisError
from kros.data import Population
from kros.design.methods.gains import OpenLoop
from kros.design.methods.robust import WorstCaseH2
from kros.identify.presets import lifting_settings, resolve_lifting, resolve_phase
from kros.identify.settings import CalibrationSettings
from kros.observer import run_observer
from kros.plants import PLANTS
from kros.uncertainty import UncertainModels

STATES, INPUTS = ("position", "velocity", "current"), ("target_position", "target_velocity")


@pytest.fixture(scope="module")
def population() -> Population:
    """Four DC motors, given as arrays."""
    made = PLANTS["dc-motor"](n_units=4, n_episodes=3, seconds=1.2, seed=3).simulate().population
    return given(made, {unit: [made.read(key) for key in made.keys(unit)] for unit in made.unit_ids})


def given(population: Population, data: dict[str, Any]) -> Population:
    """Other arrays with the names of a population."""
    names = {"states": population.states, "inputs": population.inputs, "measured": ["position"]}
    return kros.from_arrays(data, **names, sample_period_s=population.sample_period_s)


@pytest.fixture(scope="module")
def uncertain(population: Population) -> UncertainModels:
    models = kros.identify(population, refine=False)
    return kros.quantify(models, n_freqs=60, max_order=1)


class Refusing(OpenLoop):
    """A method that is for no kind of model."""

    def refusal(self, kind: str) -> str:
        return "it never is"


def test_states_start_where_they_do_in_training(population: Population) -> None:
    """A position and a current that are never near zero: every model would begin with their full size as an error."""
    moved = np.array([20.0, 0.0, 100.0, 20.0])
    data = {u: [population.read(key) + moved for key in population.keys(u)] for u in population.unit_ids}
    found = kros.quantify(kros.identify(given(population, data), refine=False), n_freqs=60, max_order=1)
    first = np.array([data[key.unit][int(key.episode)][0] for key in found.models.facts.train])[:, :3]
    mean, error = first.mean(axis=0), first.var(axis=0) / len(first)
    expected = mean * np.maximum(1 - error / mean**2, 0)  # James and Stein
    for method in ("open_loop", "kalman_tuned"):
        observer = kros.synthesize(found, method, methods=()).observer
        np.testing.assert_allclose(observer.initial([0.5]), [0.5, *expected[1:]], rtol=1e-9)
        np.testing.assert_allclose(observer.initial([np.nan]), expected, rtol=1e-9)
    few = {"rows": 2000, "sample": 1000, "delays": 10, "gap_samples": 5000}
    observer = kros.synthesize(found, "estimator", methods=(), estimator=few).observer
    values = np.concatenate([each for episodes in data.values() for each in episodes])
    one = next(iter(data.values()))[0]
    y, u = one[:, None, :1].copy(), one[:, None, 3:]
    y[:100] = np.nan
    early = run_observer(observer, y, u)[:100, 0]
    margin = 0.3 * np.ptp(values, axis=0)[:3]
    assert (early > values.min(axis=0)[:3] - margin).all()
    assert (early < values.max(axis=0)[:3] + margin).all()


def test_a_method_may_have_other_options(uncertain: UncertainModels) -> None:
    first = WorstCaseH2(max_order=1)
    design = kros.synthesize(uncertain, first, methods=())
    assert design.name == "linear_edmd/worst_case_h2"
    assert 0 < design.lower_bound <= design.facts["worst_case_h2"]  # type: ignore[operator]
    match = r"there is no method Refusing.* for these models; known are linear_edmd/open_loop"
    with pytest.raises(ConfigError, match=match):
        kros.synthesize(uncertain, Refusing(), methods=())


def test_everything_is_designed_where_no_method_is_named(uncertain: UncertainModels) -> None:
    observer = {"baselines": ("open_loop", "kalman_tuned")}
    design = kros.synthesize(uncertain, methods=("residual_h2",), observer=observer)
    assert design.name.split("/")[1] in ("open_loop", "kalman_tuned", "residual_h2")
    with pytest.raises(SynthesisError, match="No observer could be designed"):
        kros.synthesize(uncertain, methods=(), observer={"baselines": ()})


def test_what_is_wrong_is_named(uncertain: UncertainModels, population: Population) -> None:
    motors, models = population, uncertain.models
    for call, message in (
        (
            lambda: kros.synthesize(uncertain, "memory"),
            "no method 'memory' for these models; known are linear_edmd/open",
        ),
        (lambda: kros.synthesize(uncertain, "learned"), "there is no method 'learned'"),
        (
            lambda: kros.synthesize(uncertain, None, metods=()),
            r"Synthesize: metods: unknown key; did you mean 'methods'\?",
        ),
        (lambda: kros.synthesize(models), "Synthesize: needs UncertainModels, found IdentifiedModels"),
        (lambda: kros.quantify(motors), r"Quantify: needs .*, found Population; .*the result of kros.identify"),
        (lambda: kros.quantify(models, form="additiv"), "Quantify: form"),
        (lambda: kros.identify({"a": []}), "Identify: needs Population, found dict; read recordings"),
        (lambda: kros.identify(motors, alpha=-0.5), "Identify: alpha"),
        (lambda: kros.identify(motors, "sin(position)"), "is one text; give a list"),
        (lambda: kros.identify(motors, identify_on="loaded"), "identify_on = 'loaded'"),
        (lambda: kros.run({"a": []}, "out"), "Run: needs a Population, a folder or a study, found dict"),
        (lambda: kros.run(motors, "out", data={"reader": "parquet"}), r"data\.source and data\.reader name recordings"),
        (lambda: models.models("koopman"), "there are none, only linear_edmd"),
    ):
        with pytest.raises((ConfigError, DataError, DimensionError), match=message):
            call()


def test_units_that_were_not_recorded_where_it_counts_are_named(
    population: Population, caplog: pytest.LogCaptureFixture
) -> None:
    keys = population.keys
    data = {
        unit: {"cold" if i < 2 else "warm": [population.read(k) for k in keys(unit)]}
        for i, unit in enumerate(population.unit_ids)
    }
    found = kros.identify(given(population, data), refine=False)
    assert len(found.models().unit_ids) == 2
    assert f"Units {', '.join(population.unit_ids[2:])} were not recorded in condition 'cold'" in caplog.text


def test_episodes_with_gaps_can_be_dropped(population: Population, tmp_path) -> None:  # type: ignore[no-untyped-def]
    data = {unit: [population.read(k).copy() for k in population.keys(unit)] for unit in population.unit_ids}
    data[population.unit_ids[0]][1][7, 2] = np.nan
    gaps = given(population, data)
    with pytest.raises(DataError, match="NaN"):
        kros.identify(gaps, refine=False)
    found = kros.identify(gaps, refine=False, on_nan="drop_episode")
    assert len(found.facts.dropped) == 1
    run = kros.run(gaps, tmp_path / "run", until="read", data={"on_nan": "drop_episode"})
    assert run.metrics["study"]["units"] == len(population.unit_ids)


def recorded(states: Sequence[str] = STATES, **metadata: float) -> Population:
    samples = np.random.default_rng(0).standard_normal((2, 50, len(states) + 2))
    names = {"states": states, "inputs": INPUTS, "measured": [states[0]]}
    return kros.from_arrays({"a": list(samples)}, **names, sample_period_s=1e-3, metadata=metadata)


@pytest.mark.parametrize(
    ("functions", "metadata", "declared", "ratio"),
    [
        (["sin(100*position + phase)"], {}, {}, 100.0),
        (["cos(phase + 2*50*position)", "velocity*sin(100*position + phase)"], {}, {}, 100.0),
        (["sin(100*position + phase)"], {"gear_ratio": 50.0}, {}, 50.0),
        (["sin(100*position + phase)"], {"gear_ratio": 50.0}, {"ratio": 80.0}, 80.0),
    ],
)
def test_the_ratio_of_a_calibrated_angle_follows_from_the_formula(
    functions: list[str], metadata: dict[str, float], declared: dict[str, float], ratio: float
) -> None:
    population = recorded(**metadata)
    calibration = CalibrationSettings.of(declared, "calibrate")
    lifting = resolve_lifting(lifting_settings(functions), calibration, population)
    spec = resolve_phase(calibration, population, lifting)
    assert spec is not None
    assert (spec.angle, spec.ratio) == ("position", ratio)


@pytest.mark.parametrize(
    "functions",
    [["sin(100*position + phase)", "sin(50*position + phase)"], ["sin(position**2 + phase)"], ["phase*position"]],
)
def test_a_ratio_that_does_not_follow_is_asked_for(functions: list[str]) -> None:
    population = recorded()
    lifting = resolve_lifting(lifting_settings(functions), CalibrationSettings(), population)
    with pytest.raises(ConfigError, match=r"set calibrate\.ratio"):
        resolve_phase(CalibrationSettings(), population, lifting)
