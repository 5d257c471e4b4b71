"""What every stage gets: the study, its run folder, an executor and a progress listener."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ...core.artifacts import load_artifact
from ...core.work import Work
from ...data.population import Population
from ...data.survey import RecordingFacts
from ...identify import PhaseCalibration, PhaseSpec
from ...identify.identified import IdentifiedModels, recordings_of
from ...identify.presets import resolve_lifting, resolve_phase
from ...lifting import Lifting
from ...uncertainty.quantify import UncertainModels
from ..config import StudyConfig
from .store import Store


@dataclass(frozen=True)
class Context:
    """What a stage gets: the study, its run folder, where work runs, and recordings that are given as arrays."""

    config: StudyConfig
    store: Store
    work: Work
    given: Population | None = None

    @cached_property
    def facts(self) -> RecordingFacts:
        """What the read stage found."""
        return RecordingFacts.load(self.store.path("population"))

    @cached_property
    def population(self) -> Population:
        """The prepared recordings of the units that take part."""
        return recordings_of(self.store.folder).select(self.facts.groups)

    @cached_property
    def lifting(self) -> Lifting:
        """The Koopman lifting of the study; without functions where none is declared and none suits the plant."""
        return resolve_lifting(self.config.lifting, self.config.calibrate, self.population, self.config.split.test)

    @cached_property
    def phase_spec(self) -> PhaseSpec | None:
        """What is calibrated, if anything."""
        return resolve_phase(self.config.calibrate, self.population, self.lifting)

    @cached_property
    def calibration(self) -> PhaseCalibration | None:
        """What the calibrate stage left, where the lifting has a phase."""
        return None if self.phase_spec is None else PhaseCalibration.load(self.store.path("calibration"))

    @cached_property
    def identified(self) -> IdentifiedModels:
        """What the identify stage left."""
        return IdentifiedModels.load_models(self.store.folder, self.population, self.facts)

    @cached_property
    def uncertain(self) -> UncertainModels:
        """What the quantify stage left."""
        return UncertainModels.load_sets(self.store.folder, self.identified)

    @cached_property
    def observers_record(self) -> dict[str, Any]:
        """What the synthesize stage left beside its observers: names, facts, and which is deployed."""
        return load_artifact(self.store.path("observers"), "observers")[0]

    @cached_property
    def evaluation(self) -> dict[str, Any]:
        """What the evaluate stage left: errors of observers and baselines."""
        return load_artifact(self.store.path("evaluation"), "evaluation")[0]
