"""What every stage gets: the study, its run folder, an executor and somebody to tell about progress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ...core.artifacts import load_artifact
from ...core.loading import loader
from ...core.work import Work
from ...data.population import OUTLIERS, EpisodeKey, Population
from ...identify import ModelSet, PhaseSpec
from ...lifting import Lifting
from ...observer import Seen
from ..config import StudyConfig
from .store import Store


@dataclass(frozen=True)
class Context:
    """Surroundings of a stage."""

    config: StudyConfig
    store: Store
    work: Work

    @cached_property
    def facts(self) -> Facts:
        """What the read stage found."""
        return Facts.load(self.store.path("population"))

    @cached_property
    def population(self) -> Population:
        """The prepared recordings of the units that take part."""
        from ...data import read_parquet

        return read_parquet(self.recordings).select(self.facts.groups)

    @cached_property
    def sizes(self) -> dict[str, float]:
        """Largest absolute value of every channel in the training episodes of all units and conditions, as their factors kept it."""
        states, inputs = self.population.states, self.population.inputs
        conditions = sorted({key.condition for key in self.facts.train})
        peak = np.concatenate([load_artifact(self.factors_folder(c), "factors")[1]["peak"] for c in conditions]).max(axis=0)
        behind = len(states) + len(self.lifting.separation.basis)
        return dict(zip(states + inputs, [*peak[: len(states)].tolist(), *peak[behind : behind + len(inputs)].tolist()], strict=True))

    def seen(self, measured: Sequence[int]) -> Seen:
        """Return the sizes of the measured states and of the inputs, beyond which an observer believes less."""
        states, inputs = self.population.states, self.population.inputs
        return Seen(np.array([self.sizes[states[i]] for i in measured]), np.array([self.sizes[name] for name in inputs]))

    @property
    def recordings(self) -> Path:
        """Where the prepared recordings are."""
        return self.store.folder / self.facts.recordings  # an absolute path stays as it is

    @cached_property
    def lifting(self) -> Lifting:
        """The Koopman lifting of the study; without functions where none is declared and none suits the plant."""
        from ..presets import resolve_lifting

        return resolve_lifting(self.config, self.population)

    @cached_property
    def phase_spec(self) -> PhaseSpec | None:
        """What is calibrated, if anything."""
        from ..presets import resolve_phase

        return resolve_phase(self.config, self.population, self.lifting)

    @property
    def model_names(self) -> tuple[str, ...]:
        """Kinds of models that the study identifies; the one that others follow comes first."""
        kinds = ("koopman", "linear") if self.lifting.functions + self.lifting.input_functions else ("linear",)
        return (kinds if self.config.identify.refine else ()) + self.edmd_names

    @property
    def edmd_names(self) -> tuple[str, ...]:
        """The paper's kinds of models, identified in every condition; the first one scores outliers."""
        return ("koopman_edmd", "linear_edmd") if self.lifting.functions + self.lifting.input_functions else ("linear_edmd",)

    def factors_folder(self, condition: str) -> Path:
        """Return where the factors of a condition's training episodes are kept."""
        from urllib.parse import quote

        return self.store.path("factors", quote(condition, safe=""))

    def models(self, name: str, condition: str | None = None) -> ModelSet:
        """Load the models of one kind, in the condition that feeds the synthesis or another."""
        return ModelSet.load(self.store.path("models", self.model_folder(name, condition)))

    def model_folder(self, name: str, condition: str | None = None) -> str:
        """Return the name of the folder of models of a kind and condition."""
        if condition in (None, self.facts.identify_on):
            return name
        from urllib.parse import quote

        return f"{name}@{quote(str(condition), safe='')}"


@dataclass(frozen=True)
class Facts:
    """What the read stage leaves for all others.

    Parameters
    ----------
    recordings : Path
        Native Parquet folder, relative to the run folder when it lies inside.
    identify_on : str
    groups : mapping of unit to group
    train, test : tuple of EpisodeKey
    resolution : mapping of channel to float
        Quantisation step found in every measured channel.
    dropped : tuple of str
        Episodes that were left out, with the reason.
    alerts : tuple of str
        What looks wrong in the recordings without making them unusable.
    """

    recordings: Path
    identify_on: str
    groups: dict[str, str]
    train: tuple[EpisodeKey, ...]
    test: tuple[EpisodeKey, ...]
    resolution: dict[str, float]
    dropped: tuple[str, ...] = ()
    alerts: tuple[str, ...] = ()

    @property
    def pooled(self) -> tuple[str, ...]:
        """Units that take part in pooled results."""
        return tuple(u for u, group in self.groups.items() if group != OUTLIERS)

    def keys(self, part: str, unit: str | None = None, condition: str | None = None) -> tuple[EpisodeKey, ...]:
        """Return training or test episodes of a unit, a condition or both."""
        return tuple(k for k in getattr(self, part) if unit in (None, k.unit) and condition in (None, k.condition))

    @classmethod
    @loader
    def load(cls, folder: Path) -> Facts:
        """Read what the read stage wrote."""
        content, _ = load_artifact(folder, "facts")

        def keys(rows: list[list[str]]) -> tuple[EpisodeKey, ...]:
            return tuple(EpisodeKey(*row) for row in rows)

        return cls(
            Path(content["recordings"]),
            content["identify_on"],
            content["groups"],
            keys(content["train"]),
            keys(content["test"]),
            content["resolution"],
            tuple(content["dropped"]),
            tuple(content.get("alerts", ())),
        )
