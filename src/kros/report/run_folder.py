"""A run folder as figures see it: every artifact by name, read when first asked for.

Only files in the records of the run count. What a run does not have raises `NotShownError`, whose message says why.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import field
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from ..core import AnyArray, Names, Record, Storable, frozen, load_artifact
from ..core.arrays import T
from ..data.population import Channel, Channels, EpisodeKey, Role
from ..identify import ModelSet, PhaseCalibration
from ..identify.survey import RecordingFacts
from ..synthesis.result import Synthesis
from ..uncertainty import OutlierModel, UncertainModel
from ..uncertainty.unit_residuals import UnitResiduals
from .manifest import recorded_files
from .names import linear_first


class NotShownError(Exception):
    """A figure cannot be drawn because the run does not have what it shows; the message is the reason."""


@frozen
class Shown(Storable):
    """One held-out episode with the estimates of observers and the predictions of models."""

    KIND = "shown"
    key: EpisodeKey
    sample_period_s: float
    states: AnyArray  # shape (n_samples, n)
    inputs: AnyArray  # shape (n_samples, m)
    observers: Mapping[str, AnyArray] = field(default_factory=dict)  # by name, shape (n_samples, n)
    models: Mapping[str, AnyArray] = field(default_factory=dict)  # by name, shape (n_samples, n)

    @property
    def time_s(self) -> AnyArray:
        """Times of the samples, shape (n_samples,)."""
        return np.arange(len(self.states)) * self.sample_period_s


@frozen
class RunFolder:
    """A run that has ended, or a part of one."""

    folder: Path

    @cached_property
    def files(self) -> frozenset[str]:
        """Names of all files that belong to the run, relative to its folder."""
        return recorded_files(self.folder)

    @cached_property
    def facts(self) -> RecordingFacts:
        """Groups of units, episodes for training and testing, condition of the models."""
        return self._load("(population)/facts.json", RecordingFacts.load)["population"]

    @cached_property
    def channels(self) -> Channels:
        """Channels with their units of measure."""
        return next(iter(self.models.values())).channels

    @property
    def states(self) -> list[Channel]:
        """State channels, in column order."""
        return [c for c in self.channels if c.role is Role.STATE]

    @property
    def hidden(self) -> list[int]:
        """Columns of the states that are not measured; of all states where all are."""
        return [i for i, c in enumerate(self.states) if not c.measured] or list(range(len(self.states)))

    @property
    def sample_period_s(self) -> float:
        """Sampling period, s."""
        return next(iter(self.models.values())).sample_period_s

    @cached_property
    def calibration(self) -> PhaseCalibration:
        """The phase calibration."""
        return self._load("(calibration)/calibration.json", PhaseCalibration.load)["calibration"]

    @cached_property
    def models(self) -> dict[str, ModelSet]:
        """Models of the condition that feeds synthesis, of EDMD too where they are the start of refined ones."""
        return self._load("models/([^/@]+)/model.json", ModelSet.load)

    @property
    def kinds(self) -> Names:
        """Kinds of models that observers are designed for, the leading one first."""
        return tuple(self._record("models/models.json")["kinds"])

    @cached_property
    def uncertain(self) -> dict[str, UncertainModel]:
        """Uncertain models of the condition that feeds synthesis."""
        return self._load("uncertainty/([^/@]+)/[^/]+.json", UncertainModel.load)

    @cached_property
    def unit_residuals(self) -> dict[str, UnitResiduals]:
        """Residuals of all units relative to the weights, by kind of model."""
        return self._load("uncertainty/([^/@]+)/units/[^/]+.json", UnitResiduals.load)

    @cached_property
    def others(self) -> dict[str, UnitResiduals]:
        """Residuals of the highest-scoring unit and of all others in its condition, by kind of model."""
        residuals = self._load("outliers/([^/]+)/others/[^/]+.json", UnitResiduals.load)
        return {name.partition("@")[0]: one for name, one in residuals.items()}

    @cached_property
    def outlier_models(self) -> dict[str, OutlierModel]:
        """Outlier scores by condition."""
        models = self._load("outliers/([^/]+)/outlier_model.json", OutlierModel.load)
        return {unquote(name.partition("@")[2]) or self.facts.identify_on: one for name, one in models.items()}

    @cached_property
    def syntheses(self) -> dict[str, Synthesis]:
        """Correction filters by ``model/method``."""
        return self._load("synthesis/(.+)/synthesis.json", Synthesis.load)

    @property
    def nominal(self) -> str | None:
        """The nominal unit, where one has been chosen."""
        return self._record("uncertainty/choice.json").get("nominal")

    @property
    def deployed(self) -> str | None:
        """Name of the deployed observer, where there is one."""
        return self._record("observers/observers.json").get("deployed")

    @cached_property
    def evaluation(self) -> Record:
        """Errors of all observers and models."""
        return self._record("evaluation/evaluation.json")

    @cached_property
    def shown(self) -> list[Shown]:
        """Episodes with estimates: nominal unit, worst off-nominal unit, and the nominal unit in other conditions."""
        return list(self._load("evaluation/shown/([^/]+)/shown.json", Shown.load).values())

    def _record(self, name: str) -> Record:
        """Return the content of an artifact; nothing where the run does not have it."""
        path = self.folder / name
        return load_artifact(path.parent, path.stem)[0] if name in self.files else {}

    def _load(self, pattern: str, load: Callable[[Path], T]) -> dict[str, T]:
        """Load the folders of all files that match a regular expression, by its group, those of linear models first."""
        matches = [match for name in sorted(self.files) if (match := re.fullmatch(pattern, name))]
        if not matches:
            folder = pattern.partition("/")[0].strip("()")
            raise NotShownError(f"there is nothing to show in the folder {folder} of this run")
        return linear_first({match[1]: load((self.folder / match[0]).parent) for match in matches})
