"""Whether the loop is safe that a controller closes over estimates: for every unit, and for the uncertain set.

Certificates of an observer are about recordings that did not depend on the estimate. In the loop of a controller the
perturbation of the set is inside: small gain decides on stability, and the worst gain from command to error takes the
place of the bound that is void. Beside this stands a simulation of every unit with the observer as it is deployed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...core import TINY, Names, Record, SynthesisError, hinf_norm
from ...data import EpisodeBatch
from ...observer import Observer
from ...uncertainty import UncertainModels
from .controller import Controller
from .linear_loop import LinearLoop
from .simulated_loop import diverging
from .small_gain import attained, least_level

ASSUMPTIONS: Names = (
    "for margin, gain and spectral radius the loop is linear: functions are those of the plant, nothing saturates",
    "perturbations are linear systems of the set; every measurement arrives, and in time",
    "commands are independent of one another, which recorded ones may not be",
)


@dataclass(frozen=True)
class LoopResult:
    """What is known about a loop; None is not known.

    SAFE: stability is proven for the whole set, and no unit diverges in simulation. NOT SAFE: the loop of a unit, or of
    a member of the set, is not stable. UNDECIDED: there is no linear analysis, or its bounds are on both sides of the
    set.

    Examples
    --------
    >>> from kros.evaluate.closed_loop import LoopResult
    >>> LoopResult("SAFE", margin=2.0, destabilising=2.5, at_hz=3.0).lines()[0]
    'SAFE: stability is proven for 2 times the uncertain set; 2.5 times the set destabilises, at 3 Hz'
    """

    status: str
    reasons: Names = ()  # of a verdict that is not SAFE
    margin: float | None = None  # largest scaling of the set for which stability is proven
    destabilising: float | None = None  # smallest scaling for which a perturbation was found that destabilises
    at_hz: float | None = None  # its frequency
    spectral_radius: Mapping[str, float] = field(default_factory=dict)  # of every unit's loop
    diverged: Names = ()  # units whose nonlinear loop diverges in simulation
    error_gain: float | None = None  # proven largest gain from command to error over the set, signals in ranges
    nominal_gain: float | None = None  # that of the nominal unit
    assumptions: Names = ASSUMPTIONS

    def lines(self) -> list[str]:
        """Return what people read."""
        said = list(self.reasons)
        if self.margin is not None:
            said += [f"stability is proven for {self.margin:.4g} times the uncertain set"]
            said += [f"{self.destabilising:.4g} times the set destabilises, at {self.at_hz:.3g} Hz"]
        lines = [f"{self.status}: {'; '.join(said)}"]
        if self.error_gain is not None:
            both = f"at most {self.error_gain:.4g} over the set, {self.nominal_gain:.4g} for the nominal unit"
            lines.append(f"gain from command to error, in ranges: {both}")
        for unit, radius in self.spectral_radius.items():
            lines.append(f"  unit {unit}: spectral radius {radius:.6g}{', diverges' if unit in self.diverged else ''}")
        return [*lines, *(f"  assumed: {text}" for text in self.assumptions)]


def close_loop(
    observer: Observer,
    uncertain: UncertainModels,
    controller: Any,
    samples: int = 5000,
    largest: float = 100.0,
    tolerance: float = 0.01,
) -> LoopResult:
    """Judge the loop of a controller that uses an observer's estimates, on all units and on the uncertain set.

    Parameters
    ----------
    observer : Observer
        As it is deployed; its name says which kind of model it belongs to, the first one otherwise.
    uncertain : UncertainModels
        Models of all units and the set around them, as `kros.quantify` returns them.
    controller : Controller or control.StateSpace
        From estimated states to inputs, by name, in the units of the recordings.
    samples : int
        Of a simulation, at most.
    largest : float
        In ranges: a state beyond has diverged.
    tolerance : float
        Relative width of the searches for margin and gain.

    Returns
    -------
    LoopResult

    Raises
    ------
    ConfigError, DimensionError
        Unknown names of signals, another sampling period, matrices that do not fit, or an observer of other lifted
        states than the models'.

    Examples
    --------
    >>> import kros
    >>> from kros.evaluate.closed_loop import Controller, close_loop
    >>> motors = kros.plants.DcMotorPopulation(n_units=3, n_episodes=3, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(motors, refine=False), n_freqs=50, max_order=1)
    >>> observer = kros.synthesize(uncertain, "kalman_tuned", methods=()).observer
    >>> weak = Controller(D=[[-1e-4]], sample_period_s=2e-3, inputs=["velocity"], outputs=["voltage"])
    >>> close_loop(observer, uncertain, weak).status
    'SAFE'
    """
    controller = controller if isinstance(controller, Controller) else Controller.from_system(controller)
    kind = observer.name.partition("/")[0]
    kind = kind if kind in uncertain.sets else next(iter(uncertain.sets))
    models, covered, facts = uncertain.models.models(kind), uncertain.sets[kind], uncertain.models.facts
    first = [facts.keys("test", unit, models.condition)[0] for unit in covered.unit_ids]
    batch = EpisodeBatch.read(uncertain.models.population, first, samples)
    diverged = diverging(observer, models, batch, controller, largest)
    reasons = [f"it diverges in simulation with {', '.join(diverged)}"] if diverged else []
    assumed = ASSUMPTIONS
    try:
        loop, left_out = LinearLoop.of(observer, models, covered, controller.between(observer, models))
    except SynthesisError as error:
        why = (*reasons, f"there is no linear analysis: {error}")
        return LoopResult("NOT SAFE" if diverged else "UNDECIDED", why, diverged=diverged)
    if left_out:
        assumed += (f"the linear estimator does without {', '.join(left_out)}",)
    scaled, units = models.normalised(), covered.unit_ids
    radius = {unit: loop.around(scaled.systems([unit])[0]).system.largest_pole() for unit in units}
    if unstable := [unit for unit, value in radius.items() if value >= 1]:
        reasons.append(f"it is unstable with {', '.join(unstable)}")
    known = bounds(loop, tolerance)
    if known["destabilising"] <= 1:
        reasons.append("it is unstable with a member of the set")
    safe = "SAFE" if known.get("margin", 0.0) >= 1 else "UNDECIDED"
    status = "NOT SAFE" if reasons else safe
    return LoopResult(status, tuple(reasons), spectral_radius=radius, diverged=diverged, assumptions=assumed, **known)


def bounds(loop: LinearLoop, tolerance: float) -> Record:
    """Return margin, what destabilises, and gains; where the nominal loop is not stable, that nothing is needed."""
    blocks = loop.perturbed()
    if not blocks.system.is_stable():
        return {"destabilising": 0.0}
    perturbation, block = blocks.perturbation, blocks.places[1]
    level, nu = least_level(perturbation, perturbation.places[1] >= 0, tolerance)
    found, at_hz = max(attained(perturbation, nu)[0], TINY), float(np.arctan(nu) / (np.pi * blocks.system.dt))
    known = {"margin": 1 / level, "destabilising": 1 / found, "at_hz": at_hz}
    if level < 1:
        known["error_gain"] = least_level(blocks, block == len(blocks.sizes) - 1, tolerance)[0]
        known["nominal_gain"] = hinf_norm(loop.around(loop.problem.scaled_model).system)
    return known
