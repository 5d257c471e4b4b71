"""Studies of recordings that are given as a population: what is declared about them counts as it does for recordings on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kros
from kros.core.errors import ConfigError, IdentificationError
from kros.data import Population, from_arrays
from kros.data.population import EpisodeKey
from kros.plants import PLANTS


def population() -> Population:
    """Four DC motors."""
    return PLANTS["dc-motor"](n_units=4, n_episodes=3, seconds=1.0, seed=3).simulate().population


def groups(given: Population, out: Path, **data: Any) -> dict[str, str]:
    """Read a population into a run folder; return what the run says about its units."""
    rows = kros.run(given, out, until="read", data=data).metrics["units"]
    return {row["unit"]: row["group"] for row in rows}


def test_what_is_declared_about_recordings_is_read_again_where_it_changed(tmp_path):
    given = population()
    first, *others = given.units
    before = groups(given, tmp_path / "run")
    after = groups(replace(given, units=(replace(first, group="outliers"), *others)), tmp_path / "run")
    assert after == before | {first.id: "outliers"}


def test_preparation_steps_are_applied_to_what_is_given(tmp_path):
    groups(population(), tmp_path / "run", prepare=[{"step": "resample", "period_s": 0.004}])
    assert kros.read(tmp_path / "run" / "recordings").sample_period_s == 0.004


def test_a_mapping_of_csv_columns_is_refused(tmp_path):
    mapping = {"files": "x", "sample_period_s": 0.1, "channel": [{"name": "x", "role": "state"}]}
    with pytest.raises(ConfigError, match="population already"):
        groups(population(), tmp_path / "run", csv=mapping)
    assert not (tmp_path / "run").exists()


def drives(unsteady: str, condition: str) -> Population:
    """Drives, one of which never runs at constant velocity and is recorded in a condition of its own."""
    simulated = PLANTS["harmonic-drive"](
        n_units=3, n_episodes=2, seconds=3.0, seed=2, conditions=("noload",)
    ).simulate()
    whole = simulated.population
    keys = {EpisodeKey(k.unit, condition if k.unit == unsteady else k.condition, k.episode): k for k in whole.episodes}
    velocity = (whole.states + whole.inputs).index("target_velocity")

    def read(key: EpisodeKey) -> np.ndarray:
        values = whole.read(keys[key]).copy()
        if key.unit == unsteady:
            values[:, velocity] += np.random.default_rng(int(key.episode)).normal(size=len(values))
        return values

    data = {key: read(key) for key in keys}
    return from_arrays(data, whole.channels, whole.sample_period_s, units=whole.units, metadata=whole.metadata)


def test_a_condition_whose_units_cannot_be_calibrated_has_no_models():
    given = drives("001002", "load")
    models = kros.identify(given, refine=False)
    assert models.conditions == ("noload",)
    assert set(models.sizes) == set(given.states + given.inputs)
    with pytest.raises(IdentificationError, match="No unit could be calibrated in 'load'"):
        kros.identify(given, refine=False, identify_on="load")


def test_a_sensor_is_that_of_a_measured_state(tmp_path):
    with pytest.raises(ConfigError, match="sensor: velocity should be among the states that are measured, position"):
        kros.run(population(), tmp_path / "run", until="read", sensor={"velocity": {"noise": 1e-3}})
