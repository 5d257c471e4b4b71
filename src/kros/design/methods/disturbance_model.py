"""What is assumed about the disturbances of a machine: the spectrum of its inputs, process noise and measurement noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.lti import StateSpace, block_diagonal
from ...synthesis import ObserverProblem

IDENTITY, TUNED = "identity", "tuned"
_CORNERS = (3e-5, 1e-3, 3e-2)  # of the sampling frequency
_NOISES = ((0.0, 0.0), (1e-2, 0.0), (0.0, 1e-1), (0.0, 1.0))  # process, measurement


@dataclass(frozen=True)
class DisturbanceModel:
    """Disturbances of an observer problem."""

    input_weight: float | str = (
        IDENTITY  # corner of the low-pass spectrum of the scaled inputs in Hz, or white inputs as in the paper
    )
    process_noise: float = 0.0
    measurement_noise: float = 0.0

    def of(self, problem: ObserverProblem) -> ObserverProblem:
        """Return the problem with these disturbances."""
        ranges = np.abs(problem.C) @ problem.output_scale
        noise = np.maximum(problem.noise, self.measurement_noise * ranges)
        problem = replace(problem, process_noise=self.process_noise * problem.output_scale, noise=noise)
        if self.input_weight == IDENTITY:
            return problem
        dt, m = problem.nominal.dt, problem.nominal.n_inputs
        pole = np.exp([[-2 * np.pi * float(self.input_weight) * dt]])
        lowpass = StateSpace(pole, 1 - pole, pole, 1 - pole, dt)
        return replace(problem, W_u=block_diagonal([lowpass] * m))

    def facts(self) -> dict[str, Any]:
        """Return it for the records."""
        corner = None if self.input_weight == IDENTITY else float(self.input_weight)
        return {
            "input_weight_hz": corner,
            "process_noise": self.process_noise,
            "measurement_noise": self.measurement_noise,
        }

    @classmethod
    def recorded(cls, facts: dict[str, Any]) -> DisturbanceModel | None:
        """Return the model that the records of an observer name; None where they name none."""
        if "process_noise" not in facts:
            return None
        corner = facts["input_weight_hz"]
        return cls(IDENTITY if corner is None else corner, facts["process_noise"], facts["measurement_noise"])


def candidates(sample_period_s: float) -> list[DisturbanceModel]:
    """Return the models that are tried: how inputs are spread over frequency and how much white noise there is nobody knows beforehand."""
    corners: tuple[float | str, ...] = (IDENTITY, *(c / sample_period_s for c in _CORNERS))
    return [DisturbanceModel(corner, *noise) for corner in corners for noise in _NOISES]
