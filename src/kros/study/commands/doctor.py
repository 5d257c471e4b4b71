"""What is installed, and what is missing for which purpose."""

from __future__ import annotations

import platform
import shutil
from importlib import metadata

_REQUIRED = ("numpy", "scipy", "sympy", "pyarrow", "pydantic", "typer", "rich", "jinja2", "matplotlib")
_OPTIONAL = {
    "distributed": "maps over units on a cluster (kros run --scheduler)",
    "pandas": "reading long data frames",
    "scikit-learn": "the estimator protocol",
    "control": "exchange with python-control",
    "fmpy": "checking exported FMUs",
}


def diagnose() -> list[str]:
    """Return lines for people."""
    lines = [
        f"kros {_version('kros') or 'not installed as a package'}   Python {platform.python_version()} on "
        f"{platform.platform(terse=True)}"
    ]
    lines += [f"  {name:<16} {_version(name) or 'MISSING: install kros again'}" for name in _REQUIRED]
    lines.append("optional")
    lines += [f"  {name:<16} {_version(name) or 'not installed'}   {purpose}" for name, purpose in _OPTIONAL.items()]
    lines.append(
        f"C compiler        {shutil.which('cc') or shutil.which('gcc') or 'none'}   for checking exported C code"
    )
    return lines


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
