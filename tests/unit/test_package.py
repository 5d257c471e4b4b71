"""The package as a user imports it: light, and complete by attribute."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import kros

ROOT = Path(__file__).parents[2]
INTERNAL = {"loops"}  # what no user calls
SUBPACKAGES = sorted({p.parent.name for p in (ROOT / "src" / "kros").glob("*/__init__.py")} - INTERNAL)
HEAVY = [
    "control",
    "dask",
    "jinja2",
    "matplotlib",
    "numpy",
    "pandas",
    "pyarrow",
    "pydantic",
    "pykoop",
    "rich",
    "scipy",
    "sklearn",
    "sympy",
    "typer",
]


def test_import_loads_no_heavy_package_and_no_subpackage() -> None:
    code = f"import kros, sys; print([m for m in sys.modules if m in {HEAVY!r} or m.startswith('kros.')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", SUBPACKAGES)
def test_every_subpackage_is_listed_and_loads(name: str) -> None:
    assert name in dir(kros)
    assert getattr(kros, name).__name__ == f"kros.{name}"


def test_dir_promises_only_what_exists() -> None:
    functions = set(dir(kros)) - {"__version__", *SUBPACKAGES}
    assert functions >= {"from_arrays", "from_frame", "read"}
    assert all(callable(getattr(kros, name)) for name in functions)


def test_unknown_attribute_names_what_there_is() -> None:
    match = r"Asked for kros\.observers; there are the functions identify, .*observer"
    with pytest.raises(AttributeError, match=match):
        _ = kros.observers
