"""The JSON schema of study files, checked by a validator that editors do not share code with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from csvs import write_csvs

from kros.plants import DcMotorPopulation

check_jsonschema = pytest.importorskip("check_jsonschema")
EXAMPLES = Path(__file__).parents[2] / "examples"


def check(*arguments: object) -> Result:
    return CliRunner().invoke(check_jsonschema.main, list(map(str, arguments)))


@pytest.fixture(scope="module")
def study(kros, tmp_path_factory) -> Path:
    """A study that `kros init` wrote, with its schema."""
    folder = tmp_path_factory.mktemp("schema")
    motors = DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.2, seed=1).simulate().population
    header = ",".join(["t", *(c.name for c in motors.channels)])
    recordings = write_csvs(folder / "recordings", motors, "motor{key.unit}_run{key.episode}.csv", header)
    result = kros("init", recordings, "--out", folder / "study.toml")
    assert result.exit_code == 0, result.output
    return folder / "study.toml"


def test_the_schema_is_one_and_is_printed(kros, study) -> None:
    schema = study.with_name("study.schema.json")
    assert check("--check-metaschema", schema).exit_code == 0
    assert json.loads(kros("schema").output) == json.loads(schema.read_text())
    assert study.read_text().splitlines()[0] == "#:schema ./study.schema.json"


def test_studies_are_valid_by_it(study) -> None:
    examples = list(EXAMPLES.glob("*/study.toml"))
    assert len(examples) > 2
    result = check("--schemafile", study.with_name("study.schema.json"), study, *examples)
    assert result.exit_code == 0, result.stdout


@pytest.mark.parametrize(
    ("right", "wrong", "found"),
    [
        ("measured = true", "measurd = true", "'measurd' was unexpected"),
        ('role = "input"', 'role = "output"', "'output' is not one of"),
        ("[data.csv]", '[[data.prepare]]\nstep = "trim"\nbegin = 1\n[data.csv]', "prepare"),
    ],
)
def test_mistakes_are_found(study, tmp_path, right, wrong, found) -> None:
    path = tmp_path / "study.toml"
    path.write_text(study.read_text().replace(right, wrong, 1))
    result = check("--schemafile", study.with_name("study.schema.json"), path)
    assert result.exit_code == 1
    assert found in result.stdout
