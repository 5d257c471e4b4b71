"""Whole studies on systems that are no gearboxes: nothing but the study file says what they are."""

from __future__ import annotations

import json

import numpy as np
import pytest

from kros.data import Population
from kros.data.readers.parquet import read_parquet
from kros.identify import ModelSet, free_run

UNITS, EPISODES, SECONDS = 4, 5, 10


@pytest.fixture(scope="module")
def pendulums(kros, tmp_path_factory):
    """A study of simulated pendulums up to its refined models."""
    folder = tmp_path_factory.mktemp("pendulums")
    options = ("--units", UNITS, "--episodes", EPISODES, "--seconds", SECONDS)
    assert kros("simulate", folder / "recordings", "--plant", "pendulum", *options).exit_code == 0
    (folder / "study.toml").write_text(
        '[data]\nsource = "recordings"\nreader = "parquet"\n[lifting]\nfunctions = ["sin(position)"]\n'
    )
    result = kros("run", folder / "study.toml", "--out", folder / "run", "--until", "identify")
    assert result.exit_code == 0, result.output
    return folder


def noise_free(truth: dict[str, float], torque: np.ndarray, period_s: float) -> np.ndarray:
    """Integrate a pendulum from rest by Runge-Kutta of order four, ten steps a sample; shape (n_samples, 2)."""

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], -truth["gravity"] * np.sin(x[0]) - truth["damping"] * x[1] + truth["gain"] * u])

    x, h, out = np.zeros(2), period_s / 10, np.empty((len(torque), 2))
    for k, u in enumerate(torque):
        out[k] = x
        for _ in range(10):
            k1 = rate(x, u)
            k2 = rate(x + h / 2 * k1, u)
            k3 = rate(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u))
    return out


def percent_from_truth(models: ModelSet, population: Population, truths: dict[str, dict[str, float]]) -> np.ndarray:
    """Free-run error of every unit on its last episode against the pendulum itself, percent of the largest value, shape (unit, 2)."""
    rows = []
    for unit in population.unit_ids:
        i = models.index(unit)
        u = population.read(population.keys(unit)[-1])[:, 2:]
        truth = noise_free(truths[unit], u[:, 0], population.sample_period_s)
        run = free_run(models.A[i], models.B[i], models.lifting, {}, truth[None, 0], u[None])[0]
        rows.append(100 * np.sqrt(np.mean((run - truth) ** 2, axis=0)) / np.abs(truth).max(axis=0))
    return np.array(rows)


def test_refined_models_are_close_to_the_pendulums_themselves(pendulums):
    population = read_parquet(pendulums / "recordings")
    truths = json.loads((pendulums / "recordings" / "truth.json").read_text())["units"]
    folder = pendulums / "run" / "models"
    found = {
        name: percent_from_truth(ModelSet.load(folder / name), population, truths)
        for name in ("koopman", "koopman_edmd", "linear")
    }
    assert found["koopman"].max() < 0.5  # the sensor's noise alone is half a percent of the velocity's range
    assert (found["koopman"].mean(axis=0) < found["koopman_edmd"].mean(axis=0)).all()
    assert (found["koopman"].mean(axis=0) < 0.25 * found["linear"].mean(axis=0)).all()
