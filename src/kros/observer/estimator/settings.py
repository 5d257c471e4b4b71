"""Every number of the estimator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from ...core import ITERATED, ConfigError, Settings


class EstimatorSettings(Settings):
    """The filter-bank estimator. Lengths are in samples or in shares of the median training episode.

    Examples
    --------
    >>> from kros.observer import EstimatorSettings
    >>> EstimatorSettings(first_lag=500.0).lags(6000), EstimatorSettings().longest(200)
    ((300.0, 600.0), 50)
    """

    unbounded: dict[str, tuple[str, ...]] = Field(
        {},
        description="measured states that may go on for ever, such as the position of a spindle, with the inputs that "
        "go on with them, such as its reference; the estimator sees their changes and distances alone",
    )
    delays: int = Field(
        100, ge=1, description="delays of every linear channel, in samples; a short episode allows a quarter of it"
    )
    first_lag: float = Field(16.0, gt=0, description="shortest time constant of the first-order lags, in samples")
    lag_ratio: float = Field(2.0, gt=1, description="ratio of successive time constants")
    last_lag: float = Field(0.1, gt=0, description="longest time constant, as a share of the median training episode")
    start: tuple[float, ...] = Field((2.0, 8.0, 32.0), description="further time constants of the start, in samples")
    start_rows: float = Field(
        10.0, ge=0, description="time during which rows of the regression are denser, in the longest of these"
    )
    features: int = Field(32, ge=0, description="random features of the richest family of channels")
    margin: float = Field(
        1.0, ge=0, description="standard errors over left-out units by which a richer family has to be better"
    )
    beyond: float = Field(
        0.25,
        ge=0,
        description="share of the training span that nonlinear channels may go beyond it; they are cut off there",
    )
    rows: int = Field(60_000, ge=1000, description="rows of the regression; more are thinned evenly")
    episodes: int = Field(300, ge=4, description="episodes of the regression; of more, some evenly spread over all")
    sample: int = Field(8_000, ge=1000, description="rows from which principal directions and covariances are found")
    sample_episodes: int = Field(60, ge=2, description="episodes of these rows")
    penalties: tuple[float, ...] = Field(
        tuple(10.0**decade for decade in range(-16, 1, 2)),
        min_length=1,
        description="penalties of the regression that are tried, relative to the bank's power",
    )
    parts: int = Field(3, ge=1, description="parts of the episodes, of which the one that is judged on is left out")
    folds: int = Field(4, ge=2, description="folds of units that are left out in turn, at most")
    nonlinear_trust: float = Field(
        1e-3, ge=0, description="relative error of a nonlinear channel: rows with target zero"
    )
    start_share: float = Field(
        0.2,
        gt=0,
        description="weight of the errors that the first sample makes at another place, for the time after a start: "
        "rows with target zero, since machines start elsewhere than in recordings",
    )
    restart_share: float = Field(
        0.03,
        gt=0,
        description="weight of the errors that a start in the middle of an episode makes, for the same time",
    )
    start_fade: float = Field(
        2.5,
        gt=0,
        description="time after a start until the second readout counts below one percent, in the slowest lags",
    )
    settled_share: float = Field(3e-3, gt=0, description="weight of the errors of `restart_share` for all other time")
    order: int | None = Field(
        None, ge=1, description="states of the filters after reduction; by default as `loss` needs"
    )
    loss: float = Field(0.01, gt=0, lt=1, description="share by which reduction may increase an error")
    measured_loss: float = Field(
        10.0,
        ge=1,
        description="ratio of the weights of hidden and measured states in the reduction",
    )
    halves: tuple[float, ...] = Field(
        (0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
        min_length=1,
        description="errors, by the Kalman filter over losses, at which the fallback counts one half, in RMS errors of "
        "the fallback; training chooses",
    )
    room: float = Field(
        0.25,
        ge=0,
        description="share of its range in training by which a hidden state may leave it; it is cut off there",
    )
    limits: dict[str, tuple[float, float]] = Field(
        {},
        description="least and largest value that a state can have, as the current of a drive; estimates stay inside",
    )
    gate: float = Field(
        5.0,
        gt=0,
        description="distance of a measurement from its estimate, in largest ones of training, from which it counts as "
        "missing; more after a start and where it is less certain",
    )
    gap_samples: int = Field(
        240_000, ge=100, description="samples on which losses are simulated in training, over all episodes"
    )
    gap_episodes: int = Field(
        32, ge=1, description="patterns of losses that are simulated on them, at least; more on short episodes"
    )
    seed: int = Field(0, ge=0, description="of the random features and of the simulated losses")

    def require_states(self, states: Sequence[str]) -> None:
        """Refuse limits of what is no state, or in the wrong order."""
        for name, (least, most) in self.limits.items():
            if name not in states or least > most:
                wanted = f"should be the least and the largest value of one of {', '.join(states)}"
                raise ConfigError(f"estimator.limits: {name} = [{least:g}, {most:g}] {wanted}; correct it.")

    def lags(self, length: float) -> tuple[float, ...]:
        """Return the time constants of the lags in samples, for a median episode of this length in samples."""
        last = self.last_lag * length
        count = max(0, int(np.ceil(np.log(last / self.first_lag) / np.log(self.lag_ratio) - ITERATED)))
        return tuple(last / self.lag_ratio**i for i in range(count, -1, -1))

    def longest(self, length: float) -> int:
        """Return the number of delays for a median episode of this length in samples."""
        return max(2, min(self.delays, int(length // 4)))
