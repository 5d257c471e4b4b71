"""Weights for residuals between a nominal and units whose responses can be asked for at any frequency, and for what the form leaves out."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..forms import Form, residual
from ..residuals import completion, misfit, sigma_max
from .check import Residuals, between_points
from .cover import Cover, Structure
from .pencils import Part, ResidualSystems
from .weight import Weight, fit_weight

Array = npt.NDArray[Any]
Responder = Callable[[Array], Array]

_LOG = logging.getLogger(__name__)
EXACT = 1e-9  # relative misfit up to which a form is said to rebuild every unit: rounding
WORTH_SAYING = 0.01  # a misfit that makes another form worth a thought
_REMAINDER_TOLERANCE = 1.5  # the remainder is small: its weight may be looser by this factor


@dataclass(frozen=True, eq=False)
class Bounded:
    """Weights of a form and, where the form leaves something out, of the additive remainder; fields as in `UncertainModel`.

    Parameters
    ----------
    bound : ndarray, shape (frequency,)
        Largest residual over the units.
    cover : Cover
    weight : Weight
    misfit : ndarray, shape (unit, frequency)
    remainder : Weight or None
    remainder_cover : Cover or None
    """

    bound: Array
    cover: Cover
    weight: Weight
    misfit: Array
    remainder: Weight | None
    remainder_cover: Cover | None


def bound_residuals(
    form: Form,
    nominal: Responder,
    units: Responder,
    freqs_hz: Array,
    sample_period_s: float,
    systems: ResidualSystems | None = None,
    *,
    sampled: bool = False,
    **options: Any,
) -> Bounded:
    """Return weights for the residuals and for the remainder.

    Parameters
    ----------
    form : Form
    nominal, units : callable
        From frequencies (n,), Hz, to responses of shape (n, p, m) and (unit, n, p, m) in scaled coordinates.
    freqs_hz : ndarray, shape (frequency,), Hz
    sample_period_s : float, s
    systems : ResidualSystems, optional
        The systems behind the responses, for a proof between grid points, also of the remainder's weight.
    sampled : bool
        The responses are known at `freqs_hz` only, and nominal and units are asked for no others.
    **options
        Of `fit_weight`.

    Returns
    -------
    Bounded
    """
    options["sampled"] = sampled
    residuals = _Residuals(form, nominal, units)
    G, Gp = residuals.responses(freqs_hz)
    E = residual(form, G, Gp)
    of_form: Residuals = between_points(E, freqs_hz) if sampled else residuals.of_form
    weight, cover = fit_weight(of_form, freqs_hz, sample_period_s, systems=systems, **options)
    ratio = misfit(form, G, Gp, E)
    bound = sigma_max(E).max(axis=0)
    if not _leaves_out(form, ratio):
        return Bounded(bound, cover, weight, ratio, None, None)
    looser = options | {"tolerance_db": _REMAINDER_TOLERANCE * options["tolerance_db"]}
    if weight.structure not in (Structure.SCALAR, Structure.DIAGONAL):  # the remainder is small, and its block apart from the form's
        looser["structure"] = Structure.DIAGONAL
    left_over: Residuals = between_points(residuals.left_over(freqs_hz), freqs_hz) if sampled else residuals.left_over
    rest = None if systems is None else replace(systems, part=Part.REMAINDER)
    remainder, remainder_cover = fit_weight(left_over, freqs_hz, sample_period_s, systems=rest, **looser)
    return Bounded(bound, cover, weight, ratio, remainder, remainder_cover)


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Residuals of the scaled units at any frequency."""

    form: Form
    nominal: Responder
    units: Responder

    @cached_property
    def _memory(self) -> dict[bytes, tuple[Array, Array]]:
        return {}

    def responses(self, freqs_hz: Array) -> tuple[Array, Array]:
        """Responses of the nominal and the units."""
        key = freqs_hz.tobytes()
        if key not in self._memory:
            self._memory[key] = self.nominal(freqs_hz), self.units(freqs_hz)
        return self._memory[key]

    def of_form(self, freqs_hz: Array) -> Array:
        """Residuals of the form."""
        return residual(self.form, *self.responses(freqs_hz))

    def left_over(self, freqs_hz: Array) -> Array:
        """What the form does not rebuild; the whole difference from the nominal where the misfit is not known."""
        return completion(self.form, *self.responses(freqs_hz))[1]


def _leaves_out(form: Form, ratio: Array) -> bool:
    """Tell whether an additive remainder is needed, and warn.

    A misfit is small or large beside the *error* of an observer, which is a difference of responses: where all units agree, a thousandth of the
    response may be more than all that the weights allow. So anything beyond rounding joins the set.
    """
    unknown = int(np.isnan(ratio).sum())
    if unknown:
        _LOG.warning(
            "Uncertainty form %s: near singular (condition above 1e12) for %d of %d units and frequencies; the misfit is unknown there.",
            form.value,
            unknown,
            ratio.size,
        )
    largest = np.nanmax(ratio) if unknown < ratio.size else np.inf
    if largest <= EXACT and not unknown:
        return False
    _LOG.log(
        logging.WARNING if largest > WORTH_SAYING else logging.INFO,
        "Uncertainty form %s leaves out up to %.3g of a unit's response; an additive remainder joins the set. The additive form leaves nothing.",
        form.value,
        largest,
    )
    return True
