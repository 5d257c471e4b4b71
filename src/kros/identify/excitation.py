"""What the recordings do not show: inputs that never move, and lifted functions that depend on others."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from ..core.errors import IdentificationError
from .factors import Factor, dependent_column

log = logging.getLogger(__name__)
_ROUNDING = 1e-13  # relative: what conversions of units leave of a constant


def require_excitation(
    factor: Factor, inputs: Sequence[str], units: Sequence[str], where: str, alpha: float = 0.0
) -> None:
    """Refuse inputs that are constant over all training episodes of a unit."""
    if factor.input_range is None:
        return
    low, high = factor.input_range[..., 0, :], factor.input_range[..., 1, :]
    still = high - low <= _ROUNDING * np.maximum(np.abs(low), np.abs(high))
    dead = [name for name, zero in zip(inputs, np.all(still & (low == 0), axis=0), strict=True) if zero]
    for i, j in np.argwhere(still):
        kind = "zero" if low[i, j] == 0 else "constant"
        problem = f"unit {units[i]} ({where}): input {inputs[j]!r} is {kind} ({low[i, j]:g}) over all training episodes"
        if not alpha or inputs[j] in dead:
            zero = "declare it as another role or drop the channel"
            remedy = zero if inputs[j] in dead else "excite it, drop the channel, or use alpha > 0"
            raise IdentificationError(
                f"Identifying {problem}, so the response to it is not in the recordings; {remedy}."
            )
        log.warning("%s; its column of B is that of an offset, shrunk by alpha = %g", problem, alpha)


def require_independent(factor: Factor, names: Sequence[str], units: Sequence[str], where: str) -> None:
    """Refuse lifted data in which one column follows from those before it."""
    dependent = dependent_column(factor.R, len(names))
    if dependent is not None:
        unit, column = dependent
        raise IdentificationError(
            f"Identifying unit {units[unit]} ({where}): {names[column]!r} follows from the lifted states and inputs "
            f"before it ({', '.join(names[:column])}) on its training episodes; remove it, excite it, or use alpha > 0."
        )
