"""The lock files hold for everybody: hashed, complete, and free of addresses and paths of one machine."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
RUN, DEV = "requirements.lock", "requirements-dev.lock"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def requirements(text: str) -> list[str]:
    """Logical lines without comments."""
    joined = re.sub(r"\\\n", " ", re.sub(r"#.*", "", text))
    return [line.strip() for line in joined.splitlines() if line.strip()]


def faults(text: str) -> list[str]:
    """Lines that are not `name==version`, perhaps with a marker, followed by SHA-256 hashes."""
    good = re.compile(
        r"[a-z0-9._-]+(?:\[[a-z, ]+\])?==[\w.!+]+( *;[^-]*(?:-(?!-)[^-]*)*)?( +--hash=sha256:[0-9a-f]{64})+"
    )
    return [line[:80] for line in requirements(text) if not good.fullmatch(line)]


def pins(name: str) -> dict[str, str]:
    lines = requirements((ROOT / name).read_text(encoding="utf-8"))
    return dict(re.sub(r"\[[^]]*\]", "", line).split(" ", 1)[0].split("==") for line in lines)


def names(wanted: list[str]) -> set[str]:
    return {re.split(r"[\[<>=!~ ;]", item, maxsplit=1)[0].lower() for item in wanted}


@pytest.mark.parametrize("name", [RUN, DEV])
def test_every_requirement_is_pinned_and_hashed(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert faults(text) == []
    assert len(requirements(text)) > 20


@pytest.mark.parametrize("name", [RUN, DEV])
def test_no_address_and_no_path(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert re.findall(r"\w+://\S+|--(?:index|extra-index|find)\S*|(?<![\w.])/\w+/\S*", text) == []


def test_locks_hold_what_the_project_asks_for() -> None:
    run = (
        PROJECT["project"]["dependencies"] + PROJECT["build-system"]["requires"] + PROJECT["dependency-groups"]["build"]
    )
    assert names(run) <= set(pins(RUN))
    assert names(run + PROJECT["dependency-groups"]["dev"]) <= set(pins(DEV))


def test_extras_that_packages_ask_for_are_pinned_with_them() -> None:
    """pip takes a newer `coverage` for `coverage[toml]` where the lock pins `coverage` alone, and refuses it."""
    lines = requirements((ROOT / DEV).read_text(encoding="utf-8"))
    pinned = {line.split("==", 1)[0].replace(" ", "") for line in lines}
    pinned_names = pins(DEV)
    texts = [
        text for d in distributions() if d.name.lower() in pinned_names for text in d.requires or [] if "[" in text
    ]
    asked = [r for r in map(Requirement, texts) if r.extras and r.name in pinned_names]
    known = [r for r in asked if r.marker is None or r.marker.evaluate({"extra": ""})]
    assert {f"{r.name}[{','.join(sorted(r.extras))}]" for r in known} <= pinned


def test_development_uses_the_versions_that_are_installed() -> None:
    assert pins(RUN).items() <= pins(DEV).items()


def test_dependencies_have_no_upper_bound() -> None:
    groups = [PROJECT["project"]["dependencies"], *PROJECT["project"]["optional-dependencies"].values()]
    assert [item for group in groups for item in group if re.search(r"<|==|~=", item)] == []
