"""What is installed, and what is missing for which purpose."""

from __future__ import annotations

import platform
import shutil
from importlib import metadata

_REQUIRED = ("numpy", "scipy", "sympy", "pyarrow", "pydantic", "typer", "jinja2", "matplotlib")
_OPTIONAL = {
    "distributed": "maps over units on a cluster (kros run --scheduler)",
    "pandas": "reading long data frames",
    "scikit-learn": "the estimator protocol",
    "control": "exchange with python-control",
    "fmpy": "checking exported FMUs",
}


def diagnose() -> list[str]:
    """Return lines for people."""
    system = f"Python {platform.python_version()} on {platform.platform(terse=True)}"
    lines = [f"kros {_version('kros', 'not installed as a package')}   {system}"]
    lines += [f"  {name:<16} {_version(name, 'MISSING: install kros again')}" for name in _REQUIRED]
    lines += ["optional", *(f"  {name:<16} {_version(name, 'not installed')}   {of}" for name, of in _OPTIONAL.items())]
    compiler = shutil.which("cc") or shutil.which("gcc") or "none"
    return [*lines, f"C compiler        {compiler}   for checking exported C code"]


def _version(name: str, otherwise: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return otherwise
