"""Load torque in a study: what is made, judged, saved and told."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from kros.core.errors import ConfigError
from kros.data import split_episodes
from kros.identify.survey import RecordingFacts
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Observer
from kros.plants import HarmonicDrivePopulation
from kros.report.figures.episodes import load_torque
from kros.study.config import LoadConfig
from kros.study.engine.store import Store
from kros.study.stages.load import require_load, run_load

POPULATION = HarmonicDrivePopulation(n_units=2, n_episodes=3, seconds=3.0, seed=0, loop="soft").simulate().population


def context(folder: Path, **options: object) -> SimpleNamespace:
    """A study of two drives with a linear model, up to its evaluation."""
    population = POPULATION
    splits = split_episodes(population).values()
    train, test = (tuple(k for s in splits for k in getattr(s, part)) for part in ("train", "test"))
    facts = RecordingFacts("noload", dict.fromkeys(population.unit_ids, "population"), train, test, {})
    few = EstimatorSettings(rows=3000, sample=1000, folds=2, parts=2, delays=20, features=0, gap_samples=9_000)
    identified = SimpleNamespace(
        kinds=("linear",),
        parameters={unit: {} for unit in population.unit_ids},
        models=lambda name=None: SimpleNamespace(measured=(0,)),
        population=population,
        sizes=dict.fromkeys(population.states + population.inputs, 7.0),
    )
    return SimpleNamespace(
        config=SimpleNamespace(load=LoadConfig(**options), estimator=few),
        facts=facts,
        population=population,
        lifting=Lifting(population.states),
        identified=identified,
        uncertain=SimpleNamespace(nominal="001001"),
        store=Store(folder),
    )


def test_a_declared_load_is_found_on_the_other_units_with_the_parameters_of_the_nominal_one(tmp_path: Path) -> None:
    study = context(tmp_path, moment=0.2, inertia=0.01, units=("001002",))
    study.lifting = Lifting(POPULATION.states, ("sin(100*position + phase)",), ("phase",))
    study.identified.parameters = {unit: {"phase": 0.5 + i} for i, unit in enumerate(POPULATION.unit_ids)}
    content = run_load(study, {})
    told = content["load_torque"]
    assert told["known"] == ["001002"]
    assert [row["observer"] for row in told["rows"]] == ["koopman/load", "linear/load"]
    row = told["rows"][1]  # phases are made up here
    assert row["error_to_floor"] == pytest.approx(row["error_rms"] / row["floor_rms"])
    assert 0 < row["error_rms"] < row["load_rms"]
    koopman, linear = (Observer.load(tmp_path / "load" / f"{kind}.json") for kind in ("koopman", "linear"))
    assert linear.lifting.states[3] == "load"
    assert linear.seen is not None
    assert (koopman.parameters, linear.parameters) == ({"phase": 0.5}, {})
    run = SimpleNamespace(folder=tmp_path, evaluation=content)
    assert "linear/load" in load_torque(run)[1]


def test_without_a_moment_nothing_is_done(tmp_path: Path) -> None:
    study = context(tmp_path)
    assert run_load(study, {}) == {}
    assert not list(tmp_path.iterdir())


def test_a_study_says_what_its_load_lacks(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="condition 'load'; known 001001, 001002, others none"):
        run_load(context(tmp_path, moment=0.2), {})
    load, known = LoadConfig(moment=0.2, units=("001001",)), {"unit_ids": ("001001",), "states": ("position", "torque")}
    with pytest.raises(ConfigError, match="no unit or state 'current' in 001001 or position, torque"):
        require_load(load, SimpleNamespace(**known))
    with pytest.raises(ConfigError, match="no unit or state '001001'"):
        require_load(load, SimpleNamespace(**known | {"unit_ids": ("7",)}))
