"""What a method of observer design is, what it gets, and what it returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..core import Array, ByName, Names, Record, SynthesisError, frozen, gain, load_artifact, loader, save_artifact
from ..data import Shown
from ..identify import ModelSet
from ..observer import Observer, ReliftCertificate
from ..synthesis import Injection, ObserverProblem, Status, Synthesis
from .training import TrainingSet, percent_of, rank


@dataclass(frozen=True)
class Label:
    """What reports call a kind of observer, what it is in a few words, and how its curves look."""

    text: str
    about: str
    tone: str = "GREY"  # of `kros.report.theme.Tone`
    line: str = "-"
    baseline: bool = False


@frozen
class Method(ABC):
    """One way to an observer; its options are fields."""

    name: ClassVar[str]
    label: ClassVar[Label]

    def refusal(self, kind: str) -> str:
        """Return why the method is not used for a kind of model; empty where it is."""
        return ""

    @abstractmethod
    def design(self, task: DesignTask) -> Design:
        """Design an observer, in channels divided by their ranges; raise `SynthesisError` with the reason."""


@dataclass(frozen=True, eq=False, repr=False)
class Design(Shown):
    """One observer with what is known about it, in the recordings' units.

    Parameters
    ----------
    name : str
        ``<kind of model>/<method>``.
    observer : Observer
    synthesis : Synthesis
    facts : dict
        What the metrics of a study say.
    certificate : ReliftCertificate or None
        Of the nonlinear observer that is deployed; its `certified` says whether it holds.

    Examples
    --------
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(motors, refine=False), n_freqs=50)
    >>> design = kros.synthesize(uncertain, "kalman_tuned", methods=())
    >>> design.observer.lifting.states, design.synthesis.status.value, design.facts["order"]
    (('position', 'velocity', 'current'), 'optimal', 0)
    """

    name: str
    observer: Observer
    synthesis: Synthesis
    facts: ByName = field(default_factory=dict)
    certificate: ReliftCertificate | None = None

    def __repr__(self) -> str:
        percent, known = self.facts.get("hidden_error_percent"), "certified" if self.certified else "not certified"
        finite = percent is not None and np.isfinite(percent)
        error = f"training error {percent:.3g} %" if finite else "diverges in training"
        return f"<Design {self.name}: {self.facts.get('order')} states in the correction, {error}, {known}>"

    def _summary_rows(self) -> Record:
        facts = self.facts
        return {
            **self.observer._summary_rows(),
            **{f"bound of {state}, %": bound for state, bound in facts.get("set_bound_percent", {}).items()},
            "training error, %": facts.get("hidden_error_percent"),
            "lower bound": self.lower_bound,
            "worst-case H2": facts.get("worst_case_h2"),
            "certificate": self.certificate,
            "certified": self.certified,
        }

    @property
    def certified(self) -> bool:
        """Whether the observer is certified, for any machine and for recorded signals."""
        stable = self.certificate is not None and self.certificate.certified
        return stable and bool(self.facts.get("set_certified", True))

    @property
    def lower_bound(self) -> float | None:
        """No observer of this kind has a smaller worst-case norm; None where nothing is proven."""
        return self.synthesis.lower_bound if self.synthesis.worst_case_h2 is not None else None

    def save(self, folder: Path | str) -> None:
        """Write the observer, its synthesis and its certificate."""
        folder = Path(folder)
        self.observer.save(folder / "observer.json")
        self.synthesis.save(folder / "synthesis")
        if self.certificate is not None:
            self.certificate.save(folder / "certificate")
        save_artifact(folder, "design", {"name": self.name, "facts": self.facts})

    @classmethod
    @loader
    def load(cls, folder: Path) -> Design:
        """Read what `save` wrote."""
        folder = Path(folder)
        content, _ = load_artifact(folder, "design")
        synthesis, proof = Synthesis.load(folder / "synthesis"), ReliftCertificate.load(folder / "certificate")
        return cls(content["name"], Observer.load(folder / "observer.json"), synthesis, content["facts"], proof)


@frozen
class DesignTask:
    """One observer to design, in channels divided by their ranges."""

    name: str
    method: Method
    models: ModelSet
    unit: str
    problem: ObserverProblem | None
    refusal: str  # why there is no problem
    noise: Array  # (q,)
    training: TrainingSet
    recordings: TrainingSet
    covered: Names

    def observer(self, synthesis: Synthesis, model: tuple[Array, Array] | None = None) -> Observer:
        """Return the observer of a synthesis, with the nominal model or another one."""
        models, row = self.models, self.models.index(self.unit)
        A, B = model or (models.A[row], models.B[row])
        return Observer(
            name=self.name,
            lifting=models.lifting,
            A=A,
            B=B,
            measured=models.measured,
            inputs=models.recorded_inputs,
            controller=synthesis.controller,
            injection=synthesis.injection,
            sample_period_s=models.sample_period_s,
            parameters=models.parameters_of(self.unit),
            runtime=self.training.runtime,
            seen=self.training.seen,
            sensor=self.training.sensor,
        )

    def designed(self, synthesis: Synthesis, **facts: Any) -> Design:
        """Return the design of a synthesis that corrects the nominal model."""
        return Design(self.name, self.observer(synthesis), synthesis, facts)

    def require_problem(self) -> ObserverProblem:
        """Return the uncertain set, or say why there is none."""
        if self.problem is None:
            raise SynthesisError(self.refusal)
        return self.problem

    def open_loop(self) -> Synthesis:
        """Return the synthesis that corrects nothing."""
        nothing = np.zeros((self.models.lifting.n_lifted, len(self.models.measured)))
        return Synthesis("open_loop", gain(nothing, self.models.sample_period_s), Status.OPTIMAL, Injection.STATE)

    def best(self, observers: Sequence[Observer]) -> tuple[int, float]:
        """Return which observer ranks first on training episodes (`training.rank`), and its error to open loop."""
        limit, *errors = percent_of([self.observer(self.open_loop()), *observers], self.training.read())
        ranks = [rank(error, limit, self.models.measured) for error in errors]
        return ranks.index(min(ranks)), min(ranks)[1]


def split_name(observer: str) -> tuple[str, str]:
    """Return kind of model and method of an observer's name; what has no model has an empty kind."""
    kind, _, method = observer.rpartition("/")
    return kind, method
