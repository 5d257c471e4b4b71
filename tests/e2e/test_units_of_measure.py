"""Whole studies of the same recordings in other units of measure: the same errors, scores and estimates."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest

from kros.data import prepare, write_parquet
from kros.data.steps import Step
from kros.identify import ModelSet
from kros.observer import Observer
from kros.plants import DcMotorPopulation
from kros.study import run as run_study
from kros.study.config import Stage, validate_config

CHANNELS = ("position", "velocity", "current", "voltage")
WITHIN = 1e-9
# Weights of remainders are fitted to differences, known to 1e-7 at low frequencies; the fit makes 1e-4 of that.
WEIGHTS, SENSITIVE = "worst_case_h2", 1e-3


@dataclass(frozen=True)
class Multiplied(Step):
    """Other units, and without what states really were."""

    factors: tuple[float, ...]

    def apply(self, recording, channels, period_s):
        return replace(recording, values=recording.values[:, : len(self.factors)] * np.array(self.factors))

    def describe(self, signals):
        channels = zip(signals.channels, self.factors, strict=False)
        return replace(signals, channels=tuple(replace(c, unit=c.unit if f == 1 else "") for c, f in channels))


@pytest.fixture(scope="module")
def motors():
    population = DcMotorPopulation(n_units=3, n_episodes=3, seconds=1.4, seed=2).simulate().population
    return replace(population, metadata={})


def study(population, factors, folder, until=Stage.EVALUATE, alpha="auto"):
    scaled = prepare(population, [Multiplied(factors)])
    write_parquet(scaled, folder / "recordings")
    raw = {
        "data": {"source": str(folder / "recordings"), "reader": "parquet"},
        "lifting": {"functions": [f"tanh({1 / factors[1]!r}*velocity)"]},
        "identify": {"refine": False, "alpha": alpha},
        "uncertainty": {"n_freqs": 50},
        "synthesis": {"methods": ["worst_case_h2", "residual_h2", "estimator"]},
        "sensor": {"position": {"noise": 4e-4 * factors[0]}},
        "estimator": {"rows": 3000, "sample": 1000, "features": 8, "folds": 2, "parts": 2}
        | {"gap_episodes": 3, "gap_samples": 60_000},
    }
    metrics = run_study(validate_config(raw, folder), folder / "run", until=until).metrics
    return json.loads(json.dumps(metrics)), folder / "run"


@pytest.fixture(scope="module")
def first(motors, tmp_path_factory):
    return study(motors, (1.0, 1.0, 1.0, 1.0), tmp_path_factory.mktemp("first"))


def errors(metrics):
    found = {(r["observer"], r["unit"], r["channel"]): r["error_percent"] for r in metrics["evaluation"]}
    for name, model in metrics["models"].items():
        found |= {
            (name, channel, which): v for channel, e in model["freerun_error_percent"].items() for which, v in e.items()
        }
    return found


def within(observer):
    """Relative difference that is rounding."""
    return SENSITIVE if observer.endswith(WEIGHTS) else WITHIN


@pytest.fixture(scope="module")
def other(motors, tmp_path_factory):
    """Factors of many sizes, and the study in those units."""
    factors = 1e-9, 1e9, 1e-9, 1e9
    return factors, *study(motors, factors, tmp_path_factory.mktemp("other"))


def test_errors_scores_and_estimates_are_the_same(motors, first, other):
    factors, metrics, run = other
    one, one_run = first
    expected, found = errors(one), errors(metrics)
    assert "filtered_difference" in {key[0] for key in found}
    assert found.keys() == expected.keys()
    for key, value in found.items():
        assert value == pytest.approx(expected[key], rel=within(key[0])), key
    np.testing.assert_allclose(
        [r["score"] for r in metrics["outliers"]], [r["score"] for r in one["outliers"]], atol=1e-6
    )
    assert metrics["study"]["deployed"] == one["study"]["deployed"]
    assert metrics["study"]["alpha"] == pytest.approx(one["study"]["alpha"], rel=1e-6)
    for name, facts in one["observers"].items():
        for key in ("hidden_error_percent", "relift_gain", "worst_case_h2", "training_error_to_open_loop"):
            if facts.get(key) is not None:
                assert metrics["observers"][name][key] == pytest.approx(facts[key], rel=1e-3), (name, key)
    rms = {(r["observer"], r["unit"], r["channel"]): r["rms"] for r in one["evaluation"]}
    by = dict(zip(CHANNELS, factors, strict=True))
    for row in metrics["evaluation"]:
        key = (row["observer"], row["unit"], row["channel"])
        assert row["rms"] == pytest.approx(rms[key] * by[row["channel"]], rel=within(row["observer"])), key

    y, u = (motors.read(motors.episodes[-1])[:, None, i : i + 1] for i in (0, 3))
    runs = [Observer.load(folder / "observers" / "deployed.json") for folder in (one_run, run)]
    plain = runs[0].run(y, u)
    scaled = runs[1].run(y * factors[0], u * factors[3]) / np.array([*factors[:3], *[1.0] * (plain.shape[-1] - 3)])
    np.testing.assert_allclose(scaled[..., :3], plain[..., :3], atol=WITHIN * np.abs(plain[..., :3]).max())


def test_models_come_back_in_the_units_of_the_recordings(first, other):
    factors, _, run = other
    one, scaled = (ModelSet.load(folder / "models" / "koopman_edmd") for folder in (first[1], run))
    x = np.array([*factors[:3], 1.0])
    np.testing.assert_allclose(scaled.A * x / x[:, None], one.A, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(scaled.output_scale, one.output_scale * x, rtol=1e-12)
    assert one.alpha_in_ranges
    assert one.alpha == pytest.approx(scaled.alpha, rel=1e-6)
    assert one.lifting.functions == ("tanh(1.0*velocity)",)
