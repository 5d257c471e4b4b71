"""Settings of observer design: which methods, what they assume, and which observer is deployed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

from pydantic import Field, field_validator

from ..core.errors import ConfigError
from ..core.settings import Settings

METHODS = Literal["mixed", "paper", "worst_case_h2", "residual_h2", "memory"]
BASELINES = Literal["open_loop", "kalman_tuned", "ekf", "filtered_difference", "learned", "mean_profile"]


class SynthesisSettings(Settings):
    """Observer synthesis."""

    methods: tuple[METHODS, ...] = Field(
        ("mixed", "worst_case_h2", "residual_h2", "memory"),
        description="ways to an observer, each for every kind of model",
    )
    input_weight: float | Literal["tuned", "identity"] = Field(
        "tuned", description="corner of the low-pass spectrum of the inputs in Hz"
    )
    penalty: float = Field(1e-3, gt=0, description="on the correction, relative to the error")
    time_limit_s: float = Field(60.0, gt=0, description="for the optimisation of mixed")


class PredictorSettings(Settings):
    """The subspace-identified predictor.

    Its memory, order and the weight of every condition are chosen on training episodes of units that are left out in turn, and then it is tuned: with
    effort "full" among longer memories and more states, on five times as many recordings and by more steps than with "quick". `states` and tuning `steps`,
    on so many `episodes` of every unit and condition, may be given. `others` is how much errors in every condition besides that of synthesis
    count; with zero these conditions are left out of everything.
    `importance` weights the logarithmic errors of states that are not measured, by name; one where none is given.
    """

    effort: Literal["full", "quick"] = Field(
        "full", description="full tries longer memories, more states, more recordings and more steps than quick"
    )
    states: int | None = Field(None, ge=1, description="states besides the recorded ones; chosen where none is given")
    steps: int | None = Field(
        None, ge=0, description="most steps of tuning; by default 15 with full effort and 4 with quick"
    )
    episodes: int = Field(2, ge=1, description="of every unit and condition that tuning uses")
    others: float = Field(
        1.0,
        ge=0,
        description="how much errors count in conditions besides that of synthesis; with zero these are left out of everything",
    )
    importance: dict[str, float] = Field(
        default_factory=dict,
        description="weights of the logarithmic errors of hidden states, by name; one where none is given",
    )

    @field_validator("importance")
    @classmethod
    def _positive(cls, value: dict[str, float]) -> dict[str, float]:
        for name, weight in value.items():
            if not 0 < weight < float("inf"):
                raise ValueError(f"predictor.importance.{name} should be a positive number")
        return value

    def require_hidden(self, states: Sequence[str], measured: Sequence[str]) -> None:
        """Refuse an importance of what is no hidden state of a population."""
        hidden = [name for name in states if name not in measured]
        if unknown := sorted(set(self.importance) - set(hidden)):
            raise ConfigError(
                f"predictor.importance: {', '.join(unknown)} should be among the states that are not measured, {', '.join(hidden)}."
            )


class ObserverSettings(Settings):
    """Which observers are compared, and which one is deployed.

    The extended Kalman filter runs on the first lifted model (on a linear one it is the tuned Kalman filter); ``filtered_difference``,
    ``learned`` and ``mean_profile`` need no model.
    """

    baselines: tuple[BASELINES, ...] = Field(get_args(BASELINES), description="observers to compare with")
    deployed: str | None = Field(
        None,
        description="name of the observer that is deployed; by default the most accurate that has all certificates and tolerates dropouts",
    )
    false_alarm_rate: float = Field(
        0.02, gt=0, lt=1, description="share of good machines that the monitor of the deployed observer may report"
    )
