"""What is common to every quantified population, whether its models are known or their responses alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .forms import Form
from .nominal.choice import NominalChoice
from .weights.bounded import Bounded
from .weights.cover import Cover
from .weights.weight import Weight

Array = npt.NDArray[Any]
POOLED = "pooled"


@dataclass(frozen=True, eq=False, kw_only=True)
class Quantified:
    """A bound on how the units of a population differ from a nominal one.

    Parameters
    ----------
    form : Form
    unit_ids : tuple of str
        Units that the weights cover.
    nominal : int
        Row of the nominal unit; -1 when the nominal is none of the units (for example a pooled one).
    nominal_id : str
    freqs_hz : ndarray, shape (frequency,), Hz
    output_scale : ndarray, shape (p,)
    input_scale : ndarray, shape (m,)
    bounds : dict of Form to ndarray, shape (frequency,)
        Largest residual over the other units, for the best nominal of each form (for the chosen form: the nominal used).
    nominals : dict of Form to str
        Unit behind each of these bounds.
    cover : Cover
        Optimal cover of the residuals, frequency by frequency.
    weight : Weight
    misfit : ndarray, shape (unit, frequency)
        What the form cannot rebuild, relative to the unit; NaN where the inverse form is near singular (condition above 1e12).
    remainder : Weight or None
        Additive weights for `Gp - rebuilt(G, E)`, where the form does not rebuild every unit.
    remainder_cover : Cover or None
    """

    form: Form
    unit_ids: tuple[str, ...]
    nominal: int
    nominal_id: str
    freqs_hz: Array
    output_scale: Array
    input_scale: Array
    bounds: dict[Form, Array]
    nominals: dict[Form, str]
    cover: Cover
    weight: Weight
    misfit: Array
    remainder: Weight | None = None
    remainder_cover: Cover | None = None

    @property
    def peak_db(self) -> dict[Form, float]:
        """Peak of the bound of each form, dB; minus infinity where all units are alike."""
        with np.errstate(divide="ignore"):
            return {form: float(20 * np.log10(bound.max())) for form, bound in self.bounds.items()}

    @property
    def misfit_max(self) -> float:
        """Largest misfit where it is known; NaN where it is known nowhere."""
        known = self.misfit[np.isfinite(self.misfit)]
        return float(known.max()) if known.size else float("nan")

    @property
    def cover_max(self) -> float:
        """Largest `sigma_max(W_L^-1 E_k W_R^-1)` where it was verified; at most one."""
        return self.weight.cover_max

    @property
    def overbound_db_max(self) -> float:
        """Largest distance of the weight from the optimal cover, dB."""
        return self.weight.overbound_db_max


def findings(
    form: Form,
    unit_ids: tuple[str, ...],
    others: Sequence[str],
    index: int,
    freqs_hz: Array,
    scales: tuple[Array, Array],
    choices: Mapping[Form, NominalChoice],
    found: Bounded,
) -> dict[str, Any]:
    """Return the fields of `Quantified` for the nominal `index` among units and other candidates, -1 for a model of its own."""
    names = (*unit_ids, *others)
    name = names[index] if index >= 0 else POOLED
    return {
        "form": form,
        "unit_ids": unit_ids,
        "nominal": index if index < len(unit_ids) else -1,
        "nominal_id": name,
        "freqs_hz": freqs_hz,
        "output_scale": scales[0],
        "input_scale": scales[1],
        "bounds": {f: choice.bound for f, choice in choices.items()} | {form: found.bound},
        "nominals": {f: names[choice.index] for f, choice in choices.items()} | {form: name},
        "cover": found.cover,
        "weight": found.weight,
        "misfit": found.misfit,
        "remainder": found.remainder,
        "remainder_cover": found.remainder_cover,
    }
