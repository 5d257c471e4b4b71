"""A run folder as the report sees it: every artifact by name, read when first asked for.

Only files that the records of the run list are there; others, such as what an interrupted run left, are not looked at. What a run does not
have raises `NotShownError` with a sentence that the report prints in place of a figure or table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from urllib.parse import quote, unquote

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, read_arrays, read_json
from ..core.store import recorded_files
from ..data.population import Channel, EpisodeKey, Population, Role
from ..identify import ModelSet, PhaseCalibration
from ..observer import Observer
from ..synthesis.result import Synthesis
from ..uncertainty import OutlierModel, UncertainModel
from ..uncertainty.unit_residuals import UnitResiduals

Array = npt.NDArray[Any]
T = TypeVar("T")


class NotShownError(Exception):
    """Something cannot be shown because the run does not have it; the message is a sentence for the reader."""


@dataclass(frozen=True, eq=False)
class Shown:
    """One held-out episode with what every observer and model made of it."""

    key: EpisodeKey
    time_s: Array  # shape (n_samples,)
    states: Array  # shape (n_samples, n)
    inputs: Array  # shape (n_samples, m)
    observers: Mapping[str, Array]  # mapping of str to ndarray, shape (n_samples, n)
    models: Mapping[str, Array]  # mapping of str to ndarray, shape (n_samples, n)


@dataclass(frozen=True)
class RunFolder:
    """A finished, or half finished, run."""

    folder: Path

    @cached_property
    def files(self) -> frozenset[str]:
        """Names of all files that belong to the run, relative to its folder."""
        return recorded_files(self.folder)

    def has(self, name: str) -> bool:
        """Tell whether a file belongs to the run."""
        return name in self.files

    @cached_property
    def study(self) -> dict[str, Any]:
        """The resolved study."""
        content: dict[str, Any] = read_json(self.folder / "study.json")
        return content

    @cached_property
    def facts(self) -> dict[str, Any]:
        """What the read stage found."""
        return self._record("population", "facts", "the recordings have not been read yet")

    @property
    def identify_on(self) -> str:
        """Condition that feeds models and synthesis."""
        return str(self.facts["identify_on"])

    @cached_property
    def population(self) -> Population:
        """The recordings, where they are still in place."""
        from ..data.readers.parquet import read_parquet

        folder = self.folder / self.facts["recordings"]
        if not (folder / "population.json").exists():
            raise NotShownError("the recordings are not in their place any more")
        return read_parquet(folder)

    @cached_property
    def _described(self) -> ModelSet | Population:
        """What knows channels and sampling period: models, or the recordings where there are none yet."""
        return (
            next(iter(self.models.values()))
            if any(name.startswith("models/") for name in self.files)
            else self.population
        )

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels with their units of measure."""
        return self._described.channels

    @property
    def states(self) -> list[Channel]:
        """State channels, in column order."""
        return [c for c in self.channels if c.role is Role.STATE]

    @property
    def hidden_states(self) -> list[str]:
        """Names of the states that are not measured; all states where all are."""
        return [c.name for c in self.states if not c.measured] or [c.name for c in self.states]

    @property
    def measured_states(self) -> tuple[str, ...]:
        """States that are measured at run time; none where the run does not know its channels yet."""
        try:
            return tuple(c.name for c in self.channels if c.measured)
        except NotShownError:
            return ()

    @property
    def sample_period_s(self) -> float:
        """Sampling period, s."""
        return self._described.sample_period_s

    @cached_property
    def calibration(self) -> PhaseCalibration:
        """The phase calibration."""
        self._require(
            "calibration/calibration.json", "the lifting of this study has no phase, or it has not been calibrated yet"
        )
        return PhaseCalibration.load(self.folder / "calibration")

    @property
    def calibrated(self) -> bool:
        """Whether the study has a phase calibration, hence a disturbance that is fixed to an angle."""
        return self.has("calibration/calibration.json")

    @cached_property
    def models(self) -> dict[str, ModelSet]:
        """Models of the condition that was identified on, Koopman models first."""
        found = self._load("models", "model.json", ModelSet.load, "no models have been identified yet", at_home=True)
        return dict(sorted(found.items(), key=lambda item: (not item[0].startswith("koopman"), item[0])))

    def condition_models(self, name: str, condition: str) -> ModelSet:
        """Return the models of one kind in a condition."""
        if condition == self.identify_on:
            return self.models[name]
        place = f"models/{name}@{quote(condition, safe='')}"
        self._require(f"{place}/model.json", f"no models have been identified in condition {condition!r}")
        return ModelSet.load(self.folder / place)

    @cached_property
    def uncertain(self) -> dict[str, UncertainModel]:
        """Uncertain models of the condition that was identified on."""
        return self._load(
            "uncertainty", "*.json", UncertainModel.load, "the uncertainty has not been quantified yet", at_home=True
        )

    @cached_property
    def unit_residuals(self) -> dict[str, UnitResiduals]:
        """Residuals of all units beside the weights, by kind of model."""
        return _in_order(
            self._load("uncertainty", "units/*.json", UnitResiduals.load, "the residuals of the units were not kept")
        )

    @cached_property
    def others(self) -> tuple[str, dict[str, UnitResiduals]]:
        """Condition of the highest outlier score, and there the residuals of all units beside the cover of the others, by kind of model."""
        reason = "no unit was compared with the cover of the others; it takes two others in a condition"
        found = self._load("outliers", "others/*.json", UnitResiduals.load, reason)
        return self._condition(next(iter(found))), _in_order(
            {name.partition("@")[0]: one for name, one in found.items()}
        )

    @cached_property
    def outlier_models(self) -> dict[str, OutlierModel]:
        """Scores with all that is known about them, by condition."""
        reason = "outlier scores need at least three units in a condition"
        return {
            self._condition(name): one
            for name, one in self._load("outliers", "outlier_model.json", OutlierModel.load, reason).items()
        }

    def _condition(self, name: str) -> str:
        """Condition of a folder of models."""
        return unquote(name.partition("@")[2]) or self.identify_on

    @cached_property
    def choice(self) -> dict[str, Any]:
        """Which unit is nominal and which is worst off nominal."""
        return self._record("uncertainty", "choice", "the uncertainty has not been quantified yet")

    @cached_property
    def syntheses(self) -> dict[str, Synthesis]:
        """Syntheses by ``model/method``."""
        return self._load("synthesis/*", "synthesis.json", Synthesis.load, "no observer has been synthesized yet")

    @cached_property
    def observers_record(self) -> dict[str, Any]:
        """What the synthesis stage says about its observers."""
        return self._record("observers", "observers", "no observer has been made yet")

    @cached_property
    def observer(self) -> Observer:
        """The deployed observer itself."""
        self._require("observers/deployed.json", "no observer is deployed")
        return Observer.load(self.folder / "observers" / "deployed.json")

    @property
    def deployed(self) -> str | None:
        """Name of the deployed observer, where there is one."""
        try:
            name = self.observers_record.get("deployed")
        except NotShownError:
            return None
        return None if name is None else str(name)

    @cached_property
    def evaluation(self) -> dict[str, Any]:
        """Errors of all observers and models."""
        self._require("evaluation/evaluation.json", "the observers have not been evaluated yet")
        content: dict[str, Any] = read_json(self.folder / "evaluation" / "evaluation.json")
        return content

    @property
    def band_hz(self) -> tuple[float, float] | None:
        """Band around the gearbox frequency at top speed, Hz, where there is one."""
        found = self.evaluation.get("band_hz")
        return None if found is None else (found[0], found[1])

    @cached_property
    def disturbed(self) -> dict[str, Any]:
        """What was found on disturbed measurements; empty where the study does not ask for it."""
        return load_artifact(self.folder / "disturbed", "disturbed")[0] if self.has("disturbed/disturbed.json") else {}

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Trajectories and spectra of the evaluation."""
        return self._arrays("evaluation", "the observers have not been evaluated yet")

    @cached_property
    def shown(self) -> list[Shown]:
        """Episodes that the evaluation kept: nominal, worst off-nominal, and the nominal unit in every other condition."""
        return [self._shown(number, EpisodeKey(*row)) for number, row in enumerate(self.evaluation["shown"])]

    def _shown(self, number: int, key: EpisodeKey) -> Shown:
        start = f"shown{number}/"
        part = {name.removeprefix(start): values for name, values in self.arrays.items() if name.startswith(start)}
        observers, models = (
            {k.removeprefix(kind): v for k, v in part.items() if k.startswith(kind)} for kind in ("observer/", "model/")
        )
        return Shown(
            key,
            np.arange(len(part["states"])) * self.sample_period_s,
            part["states"],
            part["inputs"],
            observers,
            models,
        )

    def _record(self, place: str, name: str, reason: str) -> dict[str, Any]:
        self._require(f"{place}/{name}.json", reason)
        return load_artifact(self.folder / place, name)[0]

    def _arrays(self, place: str, reason: str) -> dict[str, Array]:
        self._require(f"{place}/arrays.npz", reason)
        return dict(read_arrays(self.folder / place / "arrays.npz"))

    def _load(
        self, place: str, file: str, load: Callable[[Path], T], reason: str, at_home: bool = False
    ) -> dict[str, T]:
        """Load what lies beside `file` in all folders `place`/*, by their names; both may be patterns."""
        pattern = f"{place}/*/{file}"
        depth, below = pattern.count("/"), file.count("/")
        paths = [PurePosixPath(name) for name in self.files if name.count("/") == depth]
        found = {path.parents[below]: path.parent for path in paths if path.match(pattern)}
        if not found:
            raise NotShownError(reason)
        return {
            "/".join(folder.parts[1:]): load(self.folder / found[folder])
            for folder in sorted(found)
            if not (at_home and "@" in folder.name)
        }

    def _require(self, name: str, reason: str) -> None:
        if not self.has(name):
            raise NotShownError(reason)


def _in_order(found: dict[str, T]) -> dict[str, T]:
    """Linear before Koopman, kros's own before the paper's recipe."""
    return dict(
        sorted(found.items(), key=lambda item: (item[0].endswith("_edmd"), item[0].startswith("koopman"), item[0]))
    )
