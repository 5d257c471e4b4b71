"""All models of a population: every kind in every condition, with the recordings and what was learned from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ..core import DataError, Names, Record, Storable, frozen, load_artifact, loader, save_artifact
from ..data import Population, Shown, read_parquet, write_parquet
from ..lifting import Lifting
from .calibration import PhaseCalibration
from .factors import Factor
from .model_set import ModelSet, kinds_for
from .survey import RecordingFacts

_KIND = "models"


@frozen
class EpisodeFactors(Storable):
    """Triangular factors of every training episode of one condition, free of the lifting's parameters."""

    KIND = "factors"
    condition: str
    rows: tuple[tuple[str, str], ...]
    factor: Factor

    def rows_of(self, unit: str) -> list[int]:
        """Return where the episodes of a unit are."""
        return [row for row, (of, _) in enumerate(self.rows) if of == unit]


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedModels(Shown):
    """What `kros.identify` returns.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> models = kros.identify(motors, refine=False)
    >>> models.kinds, models.conditions, models.models("linear_edmd").unit_ids == motors.unit_ids
    (('linear_edmd',), ('default',), True)
    """

    population: Population  # the recordings
    facts: RecordingFacts  # of the recordings, with the split into training and test
    lifting: Lifting  # of the Koopman models
    calibration: PhaseCalibration | None = None  # of the lifting's parameter, where it has one
    kinds: Names = ()  # of models: refined ones, or those of EDMD; the one that others follow comes first
    sets: Mapping[str, ModelSet] = field(default_factory=dict)  # by `place`; refined ones beside their start
    factors: Mapping[str, EpisodeFactors] = field(default_factory=dict)  # by condition

    def __repr__(self) -> str:
        kinds, facts = ", ".join(self.kinds), self.facts
        return f"<IdentifiedModels: {kinds} of {len(facts.pooled)} units, identified on {facts.identify_on!r}>"

    def _summary_rows(self) -> Record:
        facts = self.facts
        episodes = f"{len(facts.train)} in training, {len(facts.test)} held out, {len(facts.dropped)} left out"
        rows: Record = {
            "units": len(facts.pooled),
            "episodes": episodes,
            "functions": ", ".join(self.lifting.functions),
        }
        rows |= {kind: self.models(kind).about for kind in self.kinds}
        return rows | {"conditions": ", ".join(self.conditions), "alerts": " ".join(facts.alerts)}

    @property
    def edmd_kinds(self) -> Names:
        """The paper's kinds of models, in the order of `kinds`, in every condition; the first one scores outliers."""
        return tuple(kinds_for(self.lifting, refined=False))

    @property
    def conditions(self) -> Names:
        """Conditions that models were identified in, that of synthesis first."""
        known = {k.condition for k in self.facts.train if k.unit in self.parameters}
        return tuple(sorted(known, key=lambda c: c != self.facts.identify_on))

    @cached_property
    def parameters(self) -> dict[str, dict[str, float]]:
        """Values of the lifting's parameters of every unit that can be modelled, by name."""
        if self.calibration is None:
            return {unit: {} for unit in self.facts.groups}
        name, known = self.calibration.spec.parameter, self.calibration.units
        return {unit: {name: known[unit].phase_rad} for unit in self.facts.groups if unit in known}

    def place(self, kind: str, condition: str | None = None) -> str:
        """Return the name of the models of a kind in a condition, which is that of their folder too."""
        return kind if condition in (None, self.facts.identify_on) else f"{kind}@{quote(str(condition), safe='')}"

    def models(self, kind: str | None = None, condition: str | None = None) -> ModelSet:
        """Return the models of one kind, the first by default, in the condition that feeds synthesis or another."""
        place = self.place(kind or self.kinds[0], condition)
        if place not in self.sets:
            raise DataError(f"Models {place!r}: there are none, only {', '.join(self.sets)}; name one of them.")
        return self.sets[place]

    @cached_property
    def sizes(self) -> dict[str, float]:
        """Largest absolute value of every channel in the training episodes of all units and conditions."""
        states, inputs = self.population.states, self.population.inputs
        peak = np.concatenate([self.factors[c].factor.peak for c in sorted(self.conditions)]).max(axis=0)
        behind = len(states) + len(self.lifting.separation.basis)
        sizes = [*peak[: len(states)].tolist(), *peak[behind : behind + len(inputs)].tolist()]
        return dict(zip(states + inputs, sizes, strict=True))

    def save(self, folder: Path | str) -> None:
        """Write all of it, with the recordings, in the layout of a run folder."""
        folder = Path(folder)
        write_parquet(self.population, folder / "recordings", converted=False)
        replace(self.facts, recordings="recordings").save(folder / "population")
        if self.calibration is not None:
            self.calibration.save(folder / "calibration")
        self.save_models(folder)

    def save_models(self, folder: Path) -> None:
        """Write the models and what belongs to them, without the recordings."""
        for place, models in self.sets.items():
            models.save(folder / "models" / place)
        for condition, factors in self.factors.items():
            factors.save(folder / "factors" / quote(condition, safe=""))
        content = {"kinds": self.kinds, "sets": list(self.sets), "conditions": list(self.factors)}
        save_artifact(folder / "models", _KIND, content)

    @classmethod
    @loader
    def load(cls, folder: Path) -> IdentifiedModels:
        """Read what `save` wrote, or a run folder."""
        folder = Path(folder)
        facts = RecordingFacts.load(folder / "population")
        return cls.load_models(folder, recordings_of(folder).select(facts.groups), facts)

    @classmethod
    def load_models(cls, folder: Path, population: Population, facts: RecordingFacts) -> IdentifiedModels:
        """Read what `save_models` wrote, of recordings that are open already."""
        content, _ = load_artifact(folder / "models", _KIND)
        sets = {place: ModelSet.load(folder / "models" / place) for place in content["sets"]}
        factors = {c: EpisodeFactors.load(folder / "factors" / quote(c, safe="")) for c in content["conditions"]}
        lifting = sets[content["kinds"][0]].lifting
        calibration = PhaseCalibration.load(folder / "calibration") if lifting.parameters else None
        return cls(population, facts, lifting, calibration, tuple(content["kinds"]), sets, factors)


def recordings_of(folder: Path) -> Population:
    """Open the recordings of a run folder, or of a saved result."""
    return read_parquet(recordings_path(folder))


def recordings_path(folder: Path) -> Path:
    """Return where the recordings of a run folder, or of a saved result, are."""
    return folder / RecordingFacts.load(folder / "population").recordings  # an absolute path stays as it is
