"""The models of a population, one kind of lifting, one condition: the stage's result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..core import AnyArray, Array, ArrayLike, Names, Record, StateSpace
from ..core.artifacts import Storable
from ..core.frequency import log_grid
from ..data import Role, Shown
from ..data.population import Channels
from ..lifting import Lifting
from .edmd import KoopmanMatrices, edmd
from .factors import Ranges

EDMD = "_edmd"  # at the end of the paper's kinds of models


@dataclass(frozen=True, eq=False, repr=False)
class ModelSet(Shown, Storable):
    """Koopman (or linear) models of all units, identified in one condition.

    Examples
    --------
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> models = kros.identify(motors, refine=False).sets["linear_edmd"]
    >>> models.A.shape, models.alpha is not None, bool((models.spectral_radius() < 1).all())
    ((2, 3, 3), True, True)
    """

    KIND = "model"
    name: str  # kind of model, for example ``koopman_edmd``
    condition: str
    lifting: Lifting
    channels: Channels
    sample_period_s: float
    unit_ids: Names
    A: Array  # (unit, n, n)
    B: Array  # (unit, n, m)
    parameters: Mapping[str, Array]  # of the lifting, (unit,)
    output_scale: Array  # (n,), range of every lifted state over the pooled training episodes
    input_scale: Array  # (m,)
    alpha: float | None = None  # Tikhonov coefficient, where there is one
    alpha_in_ranges: bool = False  # whether alpha is for channels divided by the ranges or for the recordings' units
    status: Names = ()  # per unit ``ok``, or what is wrong
    longest_s: float | None = None  # longest episode, below whose inverse the models know no frequency, where known

    def _summary_rows(self) -> Record:
        functions = self.lifting.functions + self.lifting.input_functions
        rows = {"kind": self.name, "condition": self.condition, "units": len(self.unit_ids), "models": self.about}
        rows |= {"channels": ", ".join(c.label for c in self.channels), "functions": ", ".join(functions)}
        return rows | {"period": f"{self.sample_period_s:g} s"}

    @property
    def matrices(self) -> KoopmanMatrices:
        """The models' matrices."""
        return KoopmanMatrices(self.A, self.B)

    @property
    def about(self) -> str:
        """Order and largest spectral radius in a few words."""
        return f"order {self.lifting.n_lifted}, spectral radius at most {self.spectral_radius().max():.6g}"

    @property
    def recorded_inputs(self) -> Names:
        """Names of the inputs that are recorded."""
        return tuple(c.name for c in self.channels if c.role is Role.INPUT)

    @property
    def inputs(self) -> Names:
        """Names of the model's inputs, the columns of `B`: recorded inputs, then the lifting's input functions."""
        return self.recorded_inputs + self.lifting.input_functions

    @property
    def measured(self) -> tuple[int, ...]:
        """Indices of the states that are available at run time."""
        states = [c for c in self.channels if c.role is Role.STATE]
        return tuple(i for i, c in enumerate(states) if c.measured)

    @property
    def ranges(self) -> Ranges:
        """Ranges of the lifted states and the inputs."""
        return Ranges(self.output_scale, self.input_scale)

    @property
    def sizes(self) -> dict[str, float]:
        """The ranges by name."""
        return self.ranges.sizes(self.lifting, self.recorded_inputs)

    def normalised(self) -> ModelSet:
        """Return the models in channels divided by their ranges, with the lifting of such channels."""
        matrices = self.ranges.normalise(self.matrices)
        return replace(
            self,
            lifting=self.lifting.in_sizes(self.sizes),
            channels=tuple(replace(c, unit="") for c in self.channels),
            A=matrices.A,
            B=matrices.B,
            output_scale=np.ones_like(self.output_scale),
            input_scale=np.ones_like(self.input_scale),
        )

    def fit(self, R: Array) -> KoopmanMatrices:
        """Return EDMD models of other factors of ``[Psi | Theta_plus]``, with the regularisation of these."""
        alpha = self.alpha or 0.0
        return self.ranges.edmd(R, alpha) if self.alpha_in_ranges else edmd(R, self.lifting.n_lifted, alpha)

    def responses(self, freqs_hz: ArrayLike, units: Sequence[str] | None = None) -> AnyArray:
        """Return frequency responses from inputs to lifted states, shape (unit, frequency, n, m), in recorded units."""
        return self.scaled_responses(freqs_hz, units) * self.output_scale[:, None] / self.input_scale

    def scaled_responses(self, freqs_hz: ArrayLike, units: Sequence[str] | None = None) -> AnyArray:
        """Return the same with every signal divided by its range."""
        return self.normalised().systems(units).frequency_response(freqs_hz)

    def systems(self, units: Sequence[str] | None = None) -> StateSpace:
        """Return the models as a batch from input to lifted state, all of it or some units."""
        rows = [self.index(u) for u in units] if units is not None else slice(None)
        return self.matrices[rows].systems(self.sample_period_s)

    def frequencies(self, n_freqs: int = 1000, decades: float = 6.0) -> Array:
        """Return logarithmic frequencies, Hz, from what the longest episode resolves up to Nyquist."""
        return log_grid(self.sample_period_s, n_freqs, decades, self.longest_s)

    def index(self, unit: str) -> int:
        """Return the row of a unit."""
        return self._rows[unit]

    def parameters_of(self, unit: str) -> dict[str, float]:
        """Return the values of the lifting's parameters of a unit."""
        return {name: float(values[self.index(unit)]) for name, values in self.parameters.items()}

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {unit: row for row, unit in enumerate(self.unit_ids)}

    def spectral_radius(self) -> Array:
        """Return the spectral radius of every unit's model."""
        return self.ranges.normalise(self.matrices).spectral_radius()


def kinds_for(lifting: Lifting, *, refined: bool) -> dict[str, Lifting]:
    """Return the lifting of every kind of models, refined or by EDMD: without functions the linear one alone."""
    ending = "" if refined else EDMD
    lifted = {f"koopman{ending}": lifting} if lifting.functions + lifting.input_functions else {}
    return lifted | {f"linear{ending}": Lifting(lifting.states)}
