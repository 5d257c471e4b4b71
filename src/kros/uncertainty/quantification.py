"""The mechanism behind every quantification: choose the nominal, bound its residuals and what the form leaves out, name the results.

Nominal and units are responses that can be asked for at some frequencies, of systems (`systems`) or as measured (`responses`); continuous ones are
bounded on the unit circle that the bilinear map makes of the imaginary axis (`bilinear`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from ..core.norms import hinf_norm
from ..core.small_matrices import sigma_max
from .bilinear import BilinearAxis
from .forms import Form, as_form, completion, misfit, residual
from .nominal.choice import NominalChoice
from .weights.check import Residuals, between_points
from .weights.cover import Cover, Structure
from .weights.fit import fit_weight
from .weights.pencils import Part, ResidualSystems
from .weights.weight import Weight

Array = npt.NDArray[Any]
Responder = Callable[[Array], Array]

AUTO, ENTRYWISE = "auto", "entrywise"  # structures: diagonal or scalar weights; the paper's
POOLED = "pooled"  # name of a nominal that is no unit
_LOG = logging.getLogger(__name__)
_EXACT = 1e-9  # relative misfit up to which a form is said to rebuild every unit: rounding
_WORTH_SAYING = 0.01  # a misfit that makes another form worth a thought
_REMAINDER_TOLERANCE = 1.5  # the remainder is small: its weight may be looser by this factor
_LARGEST_PRODUCT = 0.7  # of |W_R W_L|: an amplification by 3.3
_PIECE = 10_000  # units times frequencies in one piece of a computation
_LOOSEST = 3.0  # overbound in tolerances at which a diagonal weight is loose


@dataclass(frozen=True, eq=False)
class Bounded:
    """Weights of a form and, where the form leaves something out, of the additive remainder; fields as in `Uncertainty`."""

    bound: Array  # (frequency,): largest residual over the units
    cover: Cover
    weight: Weight
    misfit: Array
    remainder: Weight | None = None
    remainder_cover: Cover | None = None


@dataclass(frozen=True)
class Quantification:
    """What is asked for: options of `quantify_systems`, read and checked."""

    form: Form
    entrywise: bool
    max_order: int
    tolerance_db: float

    @classmethod
    def of(cls, form: Form | str, structure: str, max_order: int, tolerance_db: float) -> Quantification:
        """Check the options; unknown ones, or an order or tolerance out of range, are a `ConfigError`."""
        if not (isinstance(max_order, (int, np.integer)) and max_order >= 0 and tolerance_db >= 0):
            raise ConfigError(
                f"Quantify: max_order = {max_order!r} should be a whole number from 0, tolerance_db = {tolerance_db} not negative."
            )
        if structure not in (AUTO, ENTRYWISE):
            raise ConfigError(
                f"Weight structure {structure!r} is unknown; choose {AUTO!r}, or {ENTRYWISE!r} for the paper's."
            )
        return cls(as_form(form), structure == ENTRYWISE, max_order, tolerance_db)

    def bound(
        self,
        nominal: Responder,
        units: Responder,
        freqs_hz: Array,
        time: float | BilinearAxis,
        *,
        systems: ResidualSystems | None = None,
        also_hz: Array | None = None,
        sampled: bool = False,
    ) -> Bounded:
        """Return weights for the residuals and the remainder, from responses as functions of Hz; a map of the axis for continuous time."""
        if isinstance(time, BilinearAxis):
            back = time.continuous_hz
            grid, dt = time.discrete_hz(freqs_hz), time.period_s
            residuals = _Residuals(self.form, lambda f: nominal(back(f)), lambda f: units(back(f)))
            found = self._bound(residuals, grid, dt, systems, also_hz, sampled)
            remainder = None if found.remainder is None else found.remainder.mapped(time.continuous)
            return replace(found, weight=found.weight.mapped(time.continuous), remainder=remainder)
        return self._bound(_Residuals(self.form, nominal, units), freqs_hz, time, systems, also_hz, sampled)

    def _bound(
        self,
        residuals: _Residuals,
        freqs_hz: Array,
        dt: float,
        systems: ResidualSystems | None,
        also_hz: Array | None,
        sampled: bool,
    ) -> Bounded:
        G, Gp = residuals.responses(freqs_hz)
        E = residuals.of_form(freqs_hz)
        options: dict[str, Any] = {"max_order": self.max_order, "also_hz": also_hz, "sampled": sampled}

        def fit(structure: Structure) -> tuple[Weight, Cover]:
            of_form: Residuals = between_points(E, freqs_hz) if sampled else residuals.of_form
            return fit_weight(
                of_form, freqs_hz, dt, structure=structure, tolerance_db=self.tolerance_db, systems=systems, **options
            )

        weight, cover = fit(Structure.ENTRYWISE) if self.entrywise else self._automatic(fit)
        ratio, bound = misfit(self.form, G, Gp, E), sigma_max(E).max(axis=0)
        if not _leaves_out(self.form, ratio):
            return Bounded(bound, cover, weight, ratio)
        left_over: Residuals = (
            between_points(residuals.left_over(freqs_hz), freqs_hz) if sampled else residuals.left_over
        )
        rest = None if systems is None else replace(systems, part=Part.REMAINDER)
        structure = Structure.DIAGONAL if weight.structure is Structure.ENTRYWISE else weight.structure
        looser = _REMAINDER_TOLERANCE * self.tolerance_db
        remainder = fit_weight(
            left_over, freqs_hz, dt, structure=structure, tolerance_db=looser, systems=rest, **options
        )
        return Bounded(bound, cover, weight, ratio, *remainder)

    def _automatic(self, fit: Callable[[Structure], tuple[Weight, Cover]]) -> tuple[Weight, Cover]:
        """Diagonal weights, or scalar ones where these are better."""
        diagonal = fit(Structure.DIAGONAL)
        weight = diagonal[0]
        loop = self.form.inverse and self.form is not Form.INVERSE_ADDITIVE
        amplified = loop and hinf_norm(weight.right @ weight.left) >= _LARGEST_PRODUCT
        if not amplified and weight.overbound_db_max <= _LOOSEST * self.tolerance_db:
            return diagonal
        scalar = fit(Structure.SCALAR)
        if not amplified and weight.overbound_db_max <= scalar[0].overbound_db_max:
            return diagonal
        reason = (
            "come close to an ill-posed set"
            if amplified
            else f"exceed the optimal ones by {weight.overbound_db_max:.1f} dB"
        )
        _LOG.info("Diagonal weights %s; scalar ones are taken.", reason)
        return scalar

    def fields(
        self,
        unit_ids: tuple[str, ...],
        index: int,
        freqs_hz: Array,
        scales: tuple[Array, Array],
        choices: Mapping[Form, NominalChoice],
        found: Bounded,
    ) -> dict[str, Any]:
        """Return the fields of `Uncertainty` for the nominal `index` among the units, -1 for a model of its own."""
        name = unit_ids[index] if index >= 0 else POOLED
        return {
            "form": self.form,
            "unit_ids": unit_ids,
            "nominal": index,
            "nominal_id": name,
            "freqs_hz": freqs_hz,
            "output_scale": scales[0],
            "input_scale": scales[1],
            "bounds": {f: choice.bound for f, choice in choices.items()} | {self.form: found.bound},
            "nominals": {f: unit_ids[choice.index] for f, choice in choices.items()} | {self.form: name},
            **{key: getattr(found, key) for key in ("cover", "weight", "misfit", "remainder", "remainder_cover")},
        }


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Residuals of the scaled units at any frequency."""

    form: Form
    nominal: Responder
    units: Responder

    @cached_property
    def _known(self) -> dict[tuple[str, bytes], Any]:
        return {}

    def _once(self, name: str, freqs_hz: Array, found: Callable[[], Any]) -> Any:
        """Return what is known at some frequencies; fits, checks and proofs ask for the same ones."""
        key = name, freqs_hz.tobytes()
        if key not in self._known:
            self._known[key] = found()
        return self._known[key]

    def responses(self, freqs_hz: Array) -> tuple[Array, Array]:
        """Responses of the nominal and the units."""
        found: tuple[Array, Array] = self._once(
            "responses", freqs_hz, lambda: (self.nominal(freqs_hz), self.units(freqs_hz))
        )
        return found

    def of_form(self, freqs_hz: Array) -> Array:
        """Residuals of the form."""

        def found() -> Array:
            G, Gp = self.responses(freqs_hz)
            return _by_pieces(lambda units: residual(self.form, G, units), Gp)

        return np.asarray(self._once("residuals", freqs_hz, found))

    def left_over(self, freqs_hz: Array) -> Array:
        """What the form does not rebuild; the whole difference from the nominal where the misfit is not known."""

        def found() -> Array:
            (G, Gp), E = self.responses(freqs_hz), self.of_form(freqs_hz)
            return _by_pieces(lambda units, E: completion(self.form, G, units, E)[1], Gp, E)

        return np.asarray(self._once("left over", freqs_hz, found))


def _by_pieces(function: Callable[..., Array], *units: Array) -> Array:
    """Return what a function of the units makes, a few units at a time: what it needs in between stays in the cache."""
    some = max(1, _PIECE // max(1, units[0].shape[1]))
    return np.concatenate([function(*(part[k : k + some] for part in units)) for k in range(0, len(units[0]), some)])


def _leaves_out(form: Form, ratio: Array) -> bool:
    """Tell whether an additive remainder is needed, and warn."""
    unknown = int(np.isnan(ratio).sum())
    if unknown:
        _LOG.warning(
            "Uncertainty form %s: near singular (condition above 1e12) for %d of %d units and frequencies; the misfit is unknown there.",
            form.value,
            unknown,
            ratio.size,
        )
    largest = np.nanmax(ratio) if unknown < ratio.size else np.inf
    if largest <= _EXACT and not unknown:
        return False
    _LOG.log(
        logging.WARNING if largest > _WORTH_SAYING else logging.INFO,
        "Uncertainty form %s leaves out up to %.3g of a unit's response; an additive remainder joins the set. The additive form leaves nothing.",
        form.value,
        largest,
    )
    return True
