"""Golden vectors: samples, faults among them, with the estimates and status bits of the observer in Python."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...observer import Observer

Array = npt.NDArray[np.float64]
SAMPLES = 64


@dataclass(frozen=True, eq=False)
class Golden:
    """Samples and what becomes of them."""

    y: Array  # (n_samples, q)
    u: Array  # (n_samples, m)
    x_hat: Array  # (n_samples, n_recorded)
    status: npt.NDArray[Any]  # (n_samples,)
    size: Array  # (n_recorded,)
    passes: int
    last_status: npt.NDArray[Any]  # (n_samples,)
    sure: npt.NDArray[
        Any
    ]  # (2, n_samples): bits of `status` and `last_status` that no change of the samples by the tolerance turns over

    @classmethod
    def of(cls, observer: Observer, track: str | None = None, count: int = SAMPLES, tolerance: float = 0.0) -> Golden:
        """Run an observer on smooth signals with a missing measurement, a lost input and a spike."""
        q, m = len(observer.measured), len(observer.inputs)
        seen = observer.seen
        y_size, u_size = (np.ones(q), np.ones(m)) if seen is None else (seen.measured, seen.inputs)
        k = np.arange(count)[:, None]
        y = y_size * 0.5 * np.sin(0.05 * k + np.arange(q))
        u = u_size * 0.5 * np.sin(0.05 * (k + 1) + np.arange(m))
        y[count // 3 : count // 3 + 3] = np.nan
        u[count // 2] = np.inf
        if seen is not None:
            y[2 * count // 3] = 40 * y_size
        passes = 1 if observer.monitor is None else 2 + observer.monitor.settle // (count // 2)

        def run(factor: float) -> tuple[Array, npt.NDArray[np.uint32]]:
            running = observer.start(factor * y[0])
            if track is not None:
                running.track(track)
            found = [
                (np.asarray(running.step(*sample)), int(running.status))
                for _ in range(passes)
                for sample in zip(factor * y, factor * u, strict=True)
            ]
            return np.array([x for x, _ in found[:count]])[:, : len(observer.recorded)], np.array(
                [s for _, s in found], np.uint32
            )

        x_hat, status = run(1.0)
        turned = (run(1 - tolerance)[1] ^ status) | (run(1 + tolerance)[1] ^ status)  # at a threshold but for rounding
        sure = ~np.stack([turned[:count], turned[-count:]])
        return cls(
            y, u, x_hat, status[:count], np.maximum(np.abs(x_hat).max(axis=0), 1e-300), passes, status[-count:], sure
        )
