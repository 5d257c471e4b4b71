"""Restarts of estimators that have none: run once more from each sample at which an observer starts again (`screen`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..samples import Screened

Array = npt.NDArray[np.float64]


def restarted(run: Callable[[Array, Array, Mapping[str, Any]], Array], samples: Screened, parameters: Mapping[str, npt.ArrayLike]) -> Array:
    """Run a batch, and every member once more from each sample at which it starts again to the next; shape (n_samples, batch, n)."""
    n_samples, batch = samples.starts.shape
    found = run(samples.y, samples.u, parameters)
    for begin in np.flatnonzero(samples.starts[1:].any(axis=1)) + 1:
        own = np.flatnonzero(samples.starts[begin])
        again = samples.starts[begin + 1 :, own]
        lasts = np.where(again.any(axis=0), begin + 1 + again.argmax(axis=0), n_samples - 1) if len(again) else begin
        rows = slice(begin, int(np.max(lasts)) + 1)
        part = {name: np.broadcast_to(np.asarray(v, dtype=float), (batch,))[own] for name, v in parameters.items()}
        found[begin + 1 : rows.stop, own] = run(samples.y[rows, own], samples.u[rows, own], part)[1:]
    return found
