"""The package as a user imports it: light, and complete by attribute."""

from __future__ import annotations

import json
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


def run_fresh(code: str) -> str:
    """Output of `code` in an interpreter that has imported nothing yet."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_after(statement: str) -> list[str]:
    code = f"{statement}\nimport json, sys\nprint(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    return json.loads(run_fresh(code))


def test_import_loads_no_heavy_package() -> None:
    assert loaded_after("import kros") == []


def test_import_loads_no_subpackage() -> None:
    assert run_fresh("import kros, sys; print([m for m in sys.modules if m.startswith('kros.')])").strip() == "[]"


@pytest.mark.parametrize("name", SUBPACKAGES)
def test_every_subpackage_is_listed_and_loads(name: str) -> None:
    assert name in dir(kros)
    assert getattr(kros, name).__name__ == f"kros.{name}"


def test_dir_promises_only_what_exists() -> None:
    functions = set(dir(kros)) - {"__version__", *SUBPACKAGES}
    assert functions >= {"from_arrays", "from_frame", "read"}
    assert all(callable(getattr(kros, name)) for name in functions)


def test_unknown_attribute_names_what_there_is() -> None:
    with pytest.raises(
        AttributeError, match=r"Asked for kros\.observers; there are the functions identify, .*observer"
    ):
        _ = kros.observers
