"""pykoop's single array, both ways: one row a sample, columns episode, states, inputs. NumPy alone, pykoop is not needed."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ..population import DEFAULT_CONDITION, Channel, EpisodeKey, Population
from .arrays import as_numbers, declare_channels, from_arrays

log = logging.getLogger(__name__)
_EXACT = 2.0**53


def from_pykoop(
    X: npt.ArrayLike | Mapping[str, npt.ArrayLike],
    n_inputs: int,
    sample_period_s: float,
    *,
    channels: Sequence[Channel] | None = None,
) -> Population:
    """Make a population from pykoop's `X`.

    Parameters
    ----------
    X : array_like, shape (n_samples, 1 + n_states + n_inputs), or mapping from unit id to such arrays
        First column the episode, then states, then inputs. One array is one unit, named ``0``. Episodes are whole numbers; in an array of
        objects they may be text, in one of floating-point numbers they must be below 2^53, where these stop telling them apart.
        Rows of an episode keep their order; where they do not stand together, as pykoop allows, a warning says so.
    n_inputs : int
        How many of the last columns are inputs.
    sample_period_s : float
    channels : sequence of Channel, optional
        Default: states ``x0, x1, ...``, all measured, inputs ``u0, u1, ...``.

    Returns
    -------
    Population

    Raises
    ------
    DataError
        Wrong sizes, or episodes that are not whole numbers.

    Examples
    --------
    >>> from kros.data import from_pykoop
    >>> X = [[0, 1.0, 0.5], [0, 1.1, 0.5], [1, 2.0, 0.0], [1, 1.9, 0.0]]  # episode, state, input
    >>> from_pykoop({"a": X, "b": X}, n_inputs=1, sample_period_s=0.01)
    Population(2 units, 1 condition, 4 episodes every 0.01 s; states x0 (measured); inputs u0)
    """
    try:
        arrays = {str(u): np.asarray(x) for u, x in X.items()} if isinstance(X, Mapping) else {"0": np.asarray(X)}
    except (TypeError, ValueError, RecursionError) as error:
        raise DataError(
            f"from_pykoop: needs an array (n_samples, n_columns) a unit, found something else ({error}); correct it."
        ) from error
    if not arrays:
        raise DataError("from_pykoop: the mapping is empty; give one array per unit.")
    if isinstance(n_inputs, bool) or not isinstance(n_inputs, (int, np.integer)):
        raise DataError(f"from_pykoop: n_inputs should be a whole number, found {n_inputs!r}; correct it.")
    widths = sorted({x.shape[-1] if x.ndim == 2 else -1 for x in arrays.values()})
    n_columns = widths[0] - 1
    if len(widths) > 1 or n_columns < 1 or not 0 <= n_inputs < n_columns:
        shapes = [x.shape for x in arrays.values()]
        raise DataError(
            f"from_pykoop: needs arrays (n_samples, 1 + states + {n_inputs}) of one width, found {shapes[:5]}; check n_inputs."
        )
    states, inputs = (
        [f"{letter}{i}" for i in range(count)] for letter, count in (("x", n_columns - n_inputs), ("u", n_inputs))
    )
    named = channels if channels is not None else declare_channels(None, states, inputs, states, "from_pykoop")
    episodes = {EpisodeKey(u, DEFAULT_CONDITION, name): part for u, x in arrays.items() for name, part in _split(u, x)}
    return from_arrays(episodes, named, sample_period_s)


def to_pykoop(population: Population) -> npt.NDArray[np.float64]:
    """Return a population as pykoop's `X`, with episodes numbered through in the order of ``population.episodes``.

    Parameters
    ----------
    population : Population

    Returns
    -------
    ndarray, shape (n_samples, 1 + n_states + n_inputs)
        Pass ``n_inputs=len(population.inputs), episode_feature=True`` to pykoop's `fit`.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> population = kros.from_arrays({"a": [np.ones((3, 2)), np.zeros((3, 2))]}, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> kros.data.to_pykoop(population).tolist()
    [[0.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    parts = [population.read(key) for key in population.episodes]
    return np.concatenate([np.column_stack([np.full(len(part), float(i)), part]) for i, part in enumerate(parts)])


def _split(unit: str, x: npt.NDArray[Any]) -> Iterable[tuple[str, npt.NDArray[np.float64]]]:
    """Yield (episode, samples) in the order in which episodes appear."""
    values = _numbers(unit, x[:, 1:])
    ids = _episodes(unit, x[:, 0])
    starts = [name for i, name in enumerate(ids) if i == 0 or name != ids[i - 1]]
    if len(starts) > len(set(starts)):
        again = next(name for i, name in enumerate(starts) if name in starts[:i])
        log.warning(
            "from_pykoop: rows of episode %s of unit %s do not stand together; they are joined in their order",
            again,
            unit,
        )
    column = np.array(ids, dtype=object)
    for name in dict.fromkeys(ids):
        yield name, values[column == name]


def _episodes(unit: str, column: npt.NDArray[Any]) -> list[str]:
    """Names of the episodes, row by row; whole numbers are written without a point."""
    if column.dtype.kind in "iu":
        return [str(v) for v in column.tolist()]
    if column.dtype.kind == "f":
        good = np.isfinite(column) & (column == np.round(column)) & (np.abs(column) < _EXACT)
    else:
        good = np.array([isinstance(v, (str, int, np.integer)) and not isinstance(v, bool) for v in column])
    if not good.all():
        row = int(np.argmin(good))
        found = column[row : row + 1].tolist()[0]
        raise DataError(
            f"from_pykoop: the first column should number the episodes (as floating-point numbers below 2**53), found {found!r} in row "
            f"{row} of unit {unit}; use an integer or object array."
        )
    return [str(int(v)) for v in column] if column.dtype.kind == "f" else [str(v) for v in column]


def _numbers(unit: str, x: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    try:
        return as_numbers(x)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"from_pykoop: states and inputs of unit {unit} should be numbers ({error}); convert them."
        ) from error
