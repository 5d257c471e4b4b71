"""The verb: from models of every unit to how the units differ.

models --scored against one another--> outliers, which may be dropped
models of the others --smallest peak residual--> nominal --residuals, covered by weights--> one uncertain set a kind of
model
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..core import ArrayLike, ConfigError, IdentificationError, Record, Work
from ..core.artifacts import load_artifact, loader, read_json, save_artifact, write_json
from ..core.linalg import sigma_max
from ..data import Shown
from ..identify import ModelSet
from ..identify.identified import IdentifiedModels
from .bounded import Options, bound_responses, bound_systems, choose_nominal, read_response_data
from .forms import Form, as_form, residual
from .model import UncertainModel
from .outliers.model import OutlierModel
from .outliers.population import score_population
from .settings import QuantifySettings
from .unit_residuals import UnitResiduals, unit_residuals

_KIND = "choice"


@dataclass(frozen=True, eq=False, repr=False)
class UncertainModels(Shown):
    """What `kros.quantify` returns for models of `kros.identify`.

    Examples
    --------
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=3, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> uncertain = kros.quantify(kros.identify(motors, refine=False), n_freqs=50, max_order=1)
    >>> list(uncertain.sets), uncertain.nominal in motors.unit_ids
    (['linear_edmd'], True)
    """

    models: IdentifiedModels  # with the recordings
    nominal: str  # unit that all others are compared with
    worst_off_nominal: str  # the unit farthest from it
    sets: Mapping[str, UncertainModel]  # by kind of model
    scores: tuple[Record, ...] = ()  # outlier scores, one row a unit and condition
    outliers: Mapping[str, OutlierModel] = field(default_factory=dict)  # by place of the models in `models.sets`

    def __repr__(self) -> str:
        flagged = sum(bool(row["outlier"]) for row in self.scores)
        kinds, scores = ", ".join(self.sets), f"{flagged} of {len(self.scores)} outlier scores flagged"
        return f"<UncertainModels: {kinds}, nominal unit {self.nominal}, {scores}>"

    def _summary_rows(self) -> Record:
        flagged = [f"{row['unit']} ({row['condition']})" for row in self.scores if row["outlier"]]
        return {
            **{kind: uncertain.about for kind, uncertain in self.sets.items()},
            "nominal unit": self.nominal,
            "farthest unit": self.worst_off_nominal,
            "outliers": ", ".join(flagged) or "none",
        }

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
        content = {
            "nominal": self.nominal,
            "worst_off_nominal": self.worst_off_nominal,
            "kinds": list(self.sets),
            "outliers": list(self.outliers),
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
        sets = {kind: UncertainModel.load(folder / "uncertainty" / kind) for kind in content["kinds"]}
        outliers = {place: OutlierModel.load(folder / "outliers" / place) for place in content["outliers"]}
        scores = tuple(read_json(folder / "outliers" / "scores.json")["rows"])
        return cls(models, content["nominal"], content["worst_off_nominal"], sets, scores, outliers)


def quantify(
    models: Any,
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    freqs_hz: ArrayLike | None = None,
    *,
    work: Work | None = None,
    **options: Any,
) -> Any:
    """Quantify how the units of a population differ from a nominal one.

    Parameters
    ----------
    models : IdentifiedModels, ModelSet, systems or responses
        Of `kros.identify`; or a batch, list or mapping by name of stable discrete systems with `A, B, C, D, dt`, with
        as many states as they like; or frequency responses, complex, of shape (unit, frequency, p, m), or objects with
        `frdata, omega, dt` as python-control has them.
    form : Form or str
        Uncertainty form of the weights; the bounds of all six are reported.
    freqs_hz : array_like, shape (frequency,), Hz, optional
        By default 1000 logarithmic points over the six decades below Nyquist, not below what the longest episode of
        recordings resolves. Arrays of responses need it.
    work : Work, optional
        Where models of `kros.identify` are quantified.
    **options
        Of models of `kros.identify`: those of `QuantifySettings`. Of all others: ``unit_ids`` (names),
        ``output_scale`` and ``input_scale`` (ranges; residuals and weights are in these units), ``nominal`` (a unit by
        row or name; by default the unit with the lowest peak), ``max_order`` (of an entry), ``tolerance_db`` (overbound
        at which a lower order is good enough), ``sample_period_s`` (s, of responses that have none: of measured ones at
        most half the inverse of the highest frequency).

    Returns
    -------
    UncertainModels, UncertainModel or ResponseUncertainty
        For models of `kros.identify`, for systems, and for responses: weights that bound the residuals of all units at
        all frequencies, or at those given. With all units identical: weights of zero and a peak of minus infinity.

    Raises
    ------
    IdentificationError
        Fewer than two identified units are left.
    DimensionError
        Sizes, sampling periods or frequencies differ, or scales do not fit.
    DataError
        Fewer than two units, unstable models, NaN.
    ConfigError
        Unknown form, nominal or option, frequencies above Nyquist, an order or tolerance out of range.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace
    >>> from kros.uncertainty import quantify
    >>> poles = np.array([0.88, 0.9, 0.91])[:, None, None]
    >>> units = StateSpace(poles, 1 - poles, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
    >>> model = quantify(units, "inverse_input_multiplicative")
    >>> model.nominal, model.cover_max <= 1
    (1, True)
    """
    if isinstance(models, IdentifiedModels):
        given = {} if freqs_hz is None else {"freqs_hz": freqs_hz}
        settings = QuantifySettings.of({"form": getattr(form, "value", form)} | given | options, "Quantify")
        return _quantify_population(models, settings, work or Work())
    if isinstance(models, Mapping):
        options["unit_ids"], models = tuple(models), list(models.values())
    if isinstance(models, list | tuple) and models and all(hasattr(model, "frdata") for model in models):
        if freqs_hz is not None:
            raise ConfigError("Quantify: response data bring their own frequencies; drop freqs_hz.")
        models, freqs_hz = read_response_data(models, options)
    bound = bound_responses if isinstance(models, np.ndarray) else bound_systems
    return bound(models, as_form(form), freqs_hz, Options.of(options, "Quantify"))


def _quantify_population(models: IdentifiedModels, settings: QuantifySettings, work: Work) -> UncertainModels:
    """Score outliers, choose the nominal of the first kind of models, and bound every kind around it."""
    outliers, scores = score_population(models, settings, work)
    first = models.models()
    units = [u for u in models.facts.pooled if u in first.unit_ids]
    if len(units) < 2:
        problem = f"Uncertainty: {len(units)} units of {len(models.facts.pooled)} have models, at least two are needed"
        raise IdentificationError(f"{problem}; record more units in the condition that feeds synthesis.")
    responses = first.scaled_responses(first.frequencies(settings.n_freqs), units)
    nominal = settings.nominal or units[choose_nominal(responses, settings.form).index]  # as in the paper, for all
    options = Options(
        unit_ids=tuple(units),
        nominal=nominal,
        max_order=settings.max_order,
        tolerance_db=settings.tolerance_db,
    )
    form, every = Form(settings.form), map(models.models, models.kinds)
    tasks = [partial(bound_systems, one, form, one.frequencies(settings.n_freqs), options) for one in every]
    sets = dict(zip(models.kinds, work.run("quantify", tasks), strict=True))
    row = units.index(nominal)
    peaks = sigma_max(residual(form, responses[row], responses)).max(axis=-1)
    peaks[row] = -np.inf
    worst_off = units[int(np.argmax(peaks))]  # the unit with the largest residual against the nominal one
    return UncertainModels(models, nominal, worst_off, sets, tuple(scores), outliers)


def residuals_beside_weights(models: ModelSet, uncertain: UncertainModel, points: int = 240) -> UnitResiduals:
    """Return the residuals of all covered units beside the weights, at about so many frequencies."""
    freqs = uncertain.freqs_hz[:: max(1, len(uncertain.freqs_hz) // points)]
    nominal = uncertain.nominal_id, uncertain.scaled_nominal().frequency_response(freqs)
    units = dict(zip(uncertain.unit_ids, models.scaled_responses(freqs, list(uncertain.unit_ids)), strict=True))
    cover = uncertain.weight.magnitudes(freqs)
    return unit_residuals(uncertain.form, nominal, units, cover, freqs, models.sample_period_s)
