"""Pykoop's single array of episodes, both ways; pykoop is not needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..core import Array, ArrayLike, DataError
from ..data import DEFAULT_CONDITION, Channel, EpisodeKey, Population, Role
from ..data.readers.arrays import as_numbers, from_arrays


def from_pykoop(
    X: ArrayLike | Mapping[str, ArrayLike],
    n_inputs: int,
    sample_period_s: float,
    *,
    channels: Sequence[Channel] | None = None,
) -> Population:
    """Make a population from pykoop's `X`; pykoop is not needed.

    Parameters
    ----------
    X : array_like, shape (n_samples, 1 + n_states + n_inputs), or mapping from unit id to such arrays
        First column the episode, a whole number, then states, then inputs. One array is one unit, named ``0``. Rows of
        an episode need not stand together and keep their order.
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
    >>> from kros.interop import from_pykoop
    >>> X = [[0, 1.0, 0.5], [0, 1.1, 0.5], [1, 2.0, 0.0], [1, 1.9, 0.0]]  # episode, state, input
    >>> from_pykoop({"a": X, "b": X}, n_inputs=1, sample_period_s=0.01)
    Population(2 units, 1 condition, 4 episodes every 0.01 s; states x0 (measured); inputs u0)
    """
    try:
        arrays = {str(u): as_numbers(x) for u, x in (X if isinstance(X, Mapping) else {"0": X}).items()}
    except (TypeError, ValueError, RecursionError) as error:
        raise DataError(
            f"from_pykoop: needs an array of numbers (n_samples, n_columns) a unit, found something else ({error}); "
            "correct it."
        ) from error
    widths = {x.shape[1] if x.ndim == 2 else 0 for x in arrays.values()}
    n_states = min(widths, default=0) - 1 - n_inputs if isinstance(n_inputs, int | np.integer) else 0
    if len(widths) != 1 or n_states < 1 or n_inputs < 0:
        raise DataError(
            f"from_pykoop: needs arrays (n_samples, 1 + states + {n_inputs}) of one width, found widths "
            f"{sorted(widths)}; check n_inputs."
        )
    if channels is None:
        states = [Channel(f"x{i}", Role.STATE, measured=True) for i in range(n_states)]
        channels = [*states, *(Channel(f"u{i}", Role.INPUT) for i in range(n_inputs))]
    episodes = dict[EpisodeKey, Array]()
    for unit, x in arrays.items():
        ids = x[:, 0]
        bad = np.flatnonzero((ids % 1 != 0) | (np.abs(ids) >= 2.0**53))
        if bad.size:
            raise DataError(
                f"from_pykoop: the first column should number the episodes (below 2**53), found {ids[bad[0]]} in row "
                f"{bad[0]} of unit {unit}; correct it."
            )
        episodes |= {EpisodeKey(unit, DEFAULT_CONDITION, str(int(i))): x[ids == i, 1:] for i in np.unique(ids)}
    return from_arrays(episodes, channels, sample_period_s)


def to_pykoop(population: Population) -> Array:
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
    >>> arrays = {"a": [np.ones((3, 2)), np.zeros((3, 2))]}
    >>> population = kros.from_arrays(arrays, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> kros.interop.to_pykoop(population)[2:4].tolist()
    [[0.0, 1.0, 1.0], [1.0, 0.0, 0.0]]
    """
    parts = [population.read(key) for key in population.episodes]
    return np.concatenate([np.column_stack([np.full(len(part), float(i)), part]) for i, part in enumerate(parts)])
