"""The examples in docstrings run, and the README stays short."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from pathlib import Path
from types import ModuleType

import pytest

import kros

ROOT = Path(__file__).parents[2]
MODULES = sorted(m.name for m in pkgutil.walk_packages(kros.__path__, "kros."))


def failures(module: ModuleType) -> list[str]:
    """Examples of a module that do not give what they say."""
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for test in doctest.DocTestFinder(exclude_empty=True).find(module):
        runner.run(test, out=report.append)
    return report


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name: str) -> None:
    assert failures(importlib.import_module(name)) == []


def test_a_wrong_example_is_found() -> None:
    module = ModuleType("wrong", ">>> 1 + 1\n3\n")
    assert "Expected:" in "".join(failures(module))


def test_readme_is_short() -> None:
    readme = ROOT / "README.md"
    if not readme.exists():
        pytest.skip("there is no README.md yet")
    assert len(readme.read_text(encoding="utf-8").splitlines()) < 150
