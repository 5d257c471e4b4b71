"""The verb: from models of every unit to how the units differ.

models --scored against one another--> outliers, which may be dropped
models of the others --smallest peak residual--> nominal --residuals, covered by weights--> one uncertain set a kind of model
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np

from ..core.artifacts import load_artifact, read_json, save_artifact, write_json
from ..core.errors import IdentificationError
from ..core.loading import loader
from ..core.lti import StateSpace
from ..core.settings import require_kind
from ..core.small_matrices import sigma_max
from ..core.work import Work
from ..identify import ModelSet
from ..identify.identified import IdentifiedModels, Stored
from .forms import residual
from .model import UncertainModel
from .nominal.choice import choose_nominal
from .outliers.model import OutlierModel
from .outliers.population import score_population
from .settings import UncertaintySettings
from .systems import quantify_systems

_KIND, _BEST = "choice", "unit"


@dataclass(frozen=True, eq=False, repr=False)
class UncertainModels:
    """What `kros.quantify` returns.

    Parameters
    ----------
    models : IdentifiedModels
        Where it comes from, with the recordings.
    nominal, worst_off_nominal : str
        Units: the one that all others are compared with, and the one farthest from it.
    dropped : tuple of str
        Units that were left out as outliers.
    sets : mapping of str to UncertainModel
        By kind of model.
    scores : tuple of dict
        Outlier scores, one row a unit and condition.
    outliers : mapping of str to OutlierModel
        By place of the models in `models.sets`.
    max_order : int
        Highest order of a weight.
    pooled : bool
        Whether observers whose nominal need not be a unit may have the mean of the units' models.

    Examples
    --------
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=3, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(motors, refine=False), n_freqs=50, max_order=1)
    >>> list(uncertain.sets), uncertain.nominal in motors.unit_ids
    (['linear_edmd'], True)
    """

    models: IdentifiedModels
    nominal: str
    worst_off_nominal: str
    dropped: tuple[str, ...]
    sets: Mapping[str, UncertainModel]
    scores: tuple[dict[str, Any], ...] = ()
    outliers: Mapping[str, OutlierModel] = field(default_factory=dict)
    max_order: int = 4
    pooled: bool = True

    def __repr__(self) -> str:
        flagged = sum(bool(row["outlier"]) for row in self.scores)
        return f"<UncertainModels: {', '.join(self.sets)} around unit {self.nominal}, {flagged} of {len(self.scores)} outlier scores flagged>"

    def save(self, folder: Path | str) -> None:
        """Write all of it, with models and recordings, in the layout of a run folder."""
        self.models.save(folder)
        self.save_sets(Path(folder))

    def save_sets(self, folder: Path) -> None:
        """Write the uncertain sets and the outlier scores, without models and recordings."""
        for kind, uncertain in self.sets.items():
            uncertain.save(folder / "uncertainty" / kind)
        for place, outliers in self.outliers.items():
            outliers.save(folder / "outliers" / place)
        write_json(folder / "outliers" / "scores.json", {"schema": 1, "rows": self.scores})
        content: dict[str, Any] = {
            "nominal": self.nominal,
            "worst_off_nominal": self.worst_off_nominal,
            "dropped": self.dropped,
        }
        content |= {
            "kinds": list(self.sets),
            "outliers": list(self.outliers),
            "max_order": self.max_order,
            "pooled": self.pooled,
        }
        save_artifact(folder / "uncertainty", _KIND, content)

    @classmethod
    @loader
    def load(cls, folder: Path) -> UncertainModels:
        """Read what `save` wrote, or a run folder."""
        return cls.load_sets(Path(folder), IdentifiedModels.load(folder))

    @classmethod
    def load_sets(cls, folder: Path, models: IdentifiedModels) -> UncertainModels:
        """Read what `save_sets` wrote, of models that are there already."""
        content, _ = load_artifact(folder / "uncertainty", _KIND)
        sets = Stored(UncertainModel.load, {kind: folder / "uncertainty" / kind for kind in content["kinds"]})
        outliers = Stored(OutlierModel.load, {place: folder / "outliers" / place for place in content["outliers"]})
        scores = tuple(read_json(folder / "outliers" / "scores.json")["rows"])
        dropped, order = tuple(content["dropped"]), content["max_order"]
        return cls(
            models,
            content["nominal"],
            content["worst_off_nominal"],
            dropped,
            sets,
            scores,
            outliers,
            order,
            content.get("pooled", True),
        )


@overload
def quantify(models: IdentifiedModels, *, work: Work | None = None, **settings: Any) -> UncertainModels: ...
@overload
def quantify(models: StateSpace | Sequence[Any], *arguments: Any, **settings: Any) -> UncertainModel: ...
def quantify(
    models: IdentifiedModels | StateSpace | Sequence[Any], *arguments: Any, work: Work | None = None, **settings: Any
) -> Any:
    """Quantify how the units of a population differ.

    Parameters
    ----------
    models : IdentifiedModels
        Of `kros.identify`. A batch or list of systems is taken as well; then all is as in `quantify_systems`.
    *arguments
        Of `quantify_systems` alone.
    work : Work, optional
        Where it runs.
    **settings
        Of `UncertaintySettings`: ``form``, ``nominal``, ``n_freqs``, ``max_order``, ``tolerance_db``, ``drop_outliers``,
        ``outlier_form``, ``false_alarm_rate``.

    Returns
    -------
    UncertainModels

    Raises
    ------
    IdentificationError
        When fewer than two units are left, or the nominal is none of them.

    Examples
    --------
    >>> import kros
    >>> drives = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> models = kros.identify(drives, refine=False)
    >>> uncertain = kros.quantify(models, n_freqs=50, max_order=1)
    >>> uncertain.sets["linear_edmd"].cover_max <= 1  # no unit is outside of the set
    True
    """
    if isinstance(models, StateSpace | list | tuple):
        return quantify_systems(models, *arguments, **settings)
    models = require_kind(
        models, IdentifiedModels, "Quantify", "identify the population first, kros.identify(population)"
    )
    asked = UncertaintySettings.of(settings, "Quantify")
    outliers, scores = score_population(models, asked, work)
    dropped = {row["unit"] for row in scores if row["outlier"]} if asked.drop_outliers else set()
    first = models.models()
    modelled = set(first.unit_ids) - dropped
    units = [u for u in models.facts.pooled if u in modelled]
    if len(units) < 2:
        raise IdentificationError(
            f"Uncertainty: {len(units)} units are left of {len(models.facts.pooled)}, at least two are needed; dropped are {sorted(dropped)}. "
            "Record more units in the condition that feeds synthesis, or keep outliers."
        )
    nominal = choose_unit(first, units, asked)
    tasks = [partial(quantify_models, models.models(kind), units, asked, nominal) for kind in models.kinds]
    sets = dict(zip(models.kinds, (work or Work()).run("quantify", tasks), strict=True))
    farthest = worst_off_nominal(first, sets[models.kinds[0]])
    return UncertainModels(
        models,
        nominal,
        farthest,
        tuple(sorted(dropped)),
        sets,
        tuple(scores),
        outliers,
        asked.max_order,
        asked.nominal is None,
    )


def choose_unit(models: ModelSet, units: list[str], settings: UncertaintySettings) -> str:
    """Return the nominal unit: the one asked for, else the best of the first kind of models, which all others share as in the paper."""
    if settings.nominal is None or (settings.nominal == _BEST and _BEST not in units):
        responses = models.scaled_responses(models.frequencies(settings.n_freqs), units)
        return units[choose_nominal(responses, settings.form).index]
    if settings.nominal not in units:
        raise IdentificationError(
            f"uncertainty.nominal = {settings.nominal!r}: is not among the units {', '.join(units)}; name one of them."
        )
    return settings.nominal


def quantify_models(models: ModelSet, units: list[str], settings: UncertaintySettings, nominal: str) -> UncertainModel:
    """Quantify one kind of model over the pooled units."""
    return quantify_systems(
        models.systems(units),
        settings.form,
        models.frequencies(settings.n_freqs),
        unit_ids=units,
        output_scale=models.output_scale,
        input_scale=models.input_scale,
        nominal=nominal,
        max_order=settings.max_order,
        tolerance_db=settings.tolerance_db,
    )


def worst_off_nominal(models: ModelSet, uncertain: UncertainModel) -> str:
    """Return the unit with the largest residual against the nominal one."""
    responses = models.scaled_responses(uncertain.freqs_hz, uncertain.unit_ids)
    peaks = sigma_max(residual(uncertain.form, responses[uncertain.nominal], responses)).max(axis=-1)
    peaks[uncertain.nominal] = -np.inf
    return uncertain.unit_ids[int(np.argmax(peaks))]
