"""What is published: the wheel is whole, its version is said once, and workflow, hooks and form do what the documents say."""

from __future__ import annotations

import re
import tomllib
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest
import yaml
from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TARGETS = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
PUBLIC = [
    ".github/workflows/tests.yml",
    ".github/ISSUE_TEMPLATE/problem.yml",
    ".github/ISSUE_TEMPLATE/config.yml",
    ".pre-commit-config.yaml",
]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    return zipfile.ZipFile(next(WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])))


def test_wheel_holds_the_whole_package_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    sources = (p for p in (ROOT / "src" / "kros").rglob("*") if p.is_file() and "__pycache__" not in p.parts)
    expected = {p.relative_to(ROOT / "src").as_posix() for p in sources}
    packed = {name for name in wheel.namelist() if not name.startswith(f"kros-{PROJECT['version']}.dist-info/")}
    assert packed == expected
    assert {"kros/py.typed", "kros/report/templates/report.html.jinja", "kros/__main__.py"} <= packed


def test_wheel_says_version_licence_and_command(wheel: zipfile.ZipFile) -> None:
    about = f"kros-{PROJECT['version']}.dist-info"
    said = HeaderParser().parsestr(wheel.read(f"{about}/METADATA").decode())
    assert (said["Version"], said["License-Expression"], said["Requires-Python"]) == (
        PROJECT["version"],
        "MIT",
        ">=3.11",
    )
    assert "kros = kros.cli:app" in wheel.read(f"{about}/entry_points.txt").decode()
    assert f"{about}/licenses/LICENSE" in wheel.namelist()


def test_version_is_one() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"]
    newest = re.search(r"^## \[(\d[\d.]*)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert newest is not None
    assert {cited, newest[1]} == {PROJECT["version"]}


def test_workflow_calls_make_on_every_python_that_is_supported() -> None:
    job = yaml.safe_load((ROOT / PUBLIC[0]).read_text(encoding="utf-8"))["jobs"]["test"]
    supported = [c.rsplit(" ", 1)[1] for c in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", c)]
    assert job["strategy"]["matrix"]["python"] == supported == ["3.11", "3.12", "3.13"]
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert {"make check", "make test", "make docs", "make dist"} <= set(commands)
    assert [c for c in commands if c.removeprefix("make ") not in TARGETS] == []


@pytest.mark.parametrize("path", ["README.md", "CONTRIBUTING.md", "docs/index.md"])
def test_targets_of_make_that_are_named_exist(path: str) -> None:
    named = re.findall(r"(?:`|\$ )make ([a-z]+)", (ROOT / path).read_text(encoding="utf-8"))
    assert named
    assert set(named) <= TARGETS


def hosts_and_paths(text: str) -> list[str]:
    """Addresses that are not public ones of this project's kind, and absolute paths."""
    return re.findall(
        r"https?://(?!github\.com|[\w.-]*\.org\b|semver\.org)\S+|(?<![\w.:/}*~-])/(?:work|home|root|tmp|opt|mnt)\b\S*",
        text,
    )


@pytest.mark.parametrize("path", [*PUBLIC, "CONTRIBUTING.md", "Makefile", ".ci/run", "pyproject.toml"])
def test_no_host_and_no_path_of_one_machine(path: str) -> None:
    assert hosts_and_paths((ROOT / path).read_text(encoding="utf-8")) == []


def test_everything_in_the_list_of_the_source_distribution_exists() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"][
        "sdist"
    ]["include"]
    assert [name for name in listed if not (ROOT / name.lstrip("/")).exists()] == []
