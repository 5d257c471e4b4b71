"""Steps from TOML tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ...core.errors import ConfigError
from ..tables import build
from .filtered import Differentiate, Resample
from .pointwise import Offset, Scale, Shift, Trim
from .step import Step

STEPS: dict[str, type[Step]] = {kind.step: kind for kind in (Scale, Shift, Offset, Trim, Resample, Differentiate)}


def parse_steps(tables: Iterable[Step | Mapping[str, Any]], where: str = "data.prepare") -> tuple[Step, ...]:
    """Return steps from TOML tables (steps pass through).

    Parameters
    ----------
    tables : iterable of mapping or Step
        For example ``[{"step": "trim", "start": 1000}]``.
    where : str
        What the messages call the list.

    Raises
    ------
    ConfigError
        An unknown step or key, a missing key, or a value of the wrong type.

    Examples
    --------
    >>> from kros.data.steps import parse_steps
    >>> parse_steps([{"step": "trim", "start": 1000}])
    (Trim(start=1000, stop=None, tail=0),)
    """
    return tuple(
        table if isinstance(table, Step) else _parse_step(table, f"{where}[{i}]") for i, table in enumerate(tables)
    )


def _parse_step(table: Mapping[str, Any], where: str) -> Step:
    name = table.get("step") if isinstance(table, Mapping) else None
    if not isinstance(name, str) or name not in STEPS:
        raise ConfigError(f"{where}: step should be one of {list(STEPS)}, found {name!r}; correct it.")
    return build(STEPS[name], {key: value for key, value in table.items() if key != "step"}, f"{where} (step {name!r})")
