"""pykoop's single array, both ways: one row a sample, columns episode, states, inputs. NumPy alone, pykoop is not needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ..population import DEFAULT_CONDITION, Channel, EpisodeKey, Population, Role, Unit
from .arrays import from_arrays


def from_pykoop(
    X: npt.ArrayLike | Mapping[str, npt.ArrayLike],
    n_inputs: int,
    sample_period_s: float,
    *,
    channels: Sequence[Channel] | None = None,
    episode_feature: bool = True,
    condition: str = DEFAULT_CONDITION,
    units: Iterable[Unit] = (),
    metadata: Mapping[str, Any] | None = None,
) -> Population:
    """Make a population from pykoop's `X`.

    Parameters
    ----------
    X : array_like, shape (n_samples, 1 + n_states + n_inputs), or mapping from unit id to such arrays
        First column the episode (whole numbers), then states, then inputs. One array is one unit, named ``0``.
    n_inputs : int
        How many of the last columns are inputs.
    sample_period_s : float
    channels : sequence of Channel, optional
        Default: states ``x0, x1, ...``, all measured, inputs ``u0, u1, ...``.
    episode_feature : bool
        False where `X` has no episode column, so each array is one episode.
    condition : str
    units : iterable of Unit
    metadata : mapping, optional

    Returns
    -------
    Population

    Raises
    ------
    DataError
        Wrong sizes, or episodes that are not whole numbers.
    """
    arrays = {str(u): np.asarray(x, dtype=float) for u, x in X.items()} if isinstance(X, Mapping) else {"0": np.asarray(X, dtype=float)}
    if not arrays:
        raise DataError("from_pykoop: the mapping is empty; give one array per unit.")
    widths = sorted({x.shape[-1] if x.ndim == 2 else -1 for x in arrays.values()})
    n_columns = widths[0] - int(episode_feature)
    if len(widths) > 1 or n_columns < 1 or not 0 <= n_inputs < n_columns:
        shapes = [x.shape for x in arrays.values()]
        raise DataError(
            f"from_pykoop: needs arrays (n_samples, {int(episode_feature)} + states + {n_inputs}) of one width, found "
            f"{shapes[:5]}; check n_inputs."
        )
    named = tuple(channels) if channels is not None else _default_channels(n_columns - n_inputs, n_inputs)
    episodes = {EpisodeKey(u, condition, name): part for u, x in arrays.items() for name, part in _split(u, x, episode_feature)}
    return from_arrays(episodes, named, sample_period_s, units=units, metadata=metadata)


def to_pykoop(population: Population, unit: str | None = None, condition: str | None = None) -> npt.NDArray[np.float64]:
    """Return episodes as pykoop's `X`.

    Parameters
    ----------
    population : Population
    unit, condition : str, optional
        Default: all, with episodes numbered through in the order of ``population.keys(unit, condition)``.

    Returns
    -------
    ndarray, shape (n_samples, 1 + n_states + n_inputs)
        Pass ``n_inputs=len(population.inputs), episode_feature=True`` to pykoop's `fit`.

    Raises
    ------
    DataError
        When there is no such episode.
    """
    keys = population.keys(unit, condition)
    if not keys:
        raise DataError(
            f"to_pykoop: no episode of unit {unit!r}, condition {condition!r}; units are "
            f"{list(population.unit_ids[:10])}, conditions {list(population.conditions)}."
        )
    parts = [population.read(key) for key in keys]
    return np.concatenate([np.column_stack([np.full(len(part), float(i)), part]) for i, part in enumerate(parts)])


def _default_channels(n_states: int, n_inputs: int) -> tuple[Channel, ...]:
    states = (Channel(f"x{i}", Role.STATE, measured=True) for i in range(n_states))
    return (*states, *(Channel(f"u{i}", Role.INPUT) for i in range(n_inputs)))


def _split(unit: str, x: npt.NDArray[np.float64], episode_feature: bool) -> Iterable[tuple[str, npt.NDArray[np.float64]]]:
    """Yield (episode, samples); rows of an episode keep their order, wherever they stand, as in pykoop."""
    if not episode_feature:
        yield "0", x
        return
    ids = x[:, 0]
    if not np.all(np.isfinite(ids)) or np.any(ids != np.round(ids)):
        bad = int(np.flatnonzero(~(np.isfinite(ids) & (ids == np.round(ids))))[0])
        raise DataError(
            f"from_pykoop: the first column should number the episodes, found {ids[bad]} in row {bad} of unit {unit}; "
            "pass episode_feature=False without it."
        )
    for number in np.unique(ids):
        yield str(int(number)), x[ids == number, 1:]
