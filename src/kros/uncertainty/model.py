r"""The uncertainty stage: models of all units in, an `UncertainModel` out.

Outputs and inputs are divided by the population's ranges first: with `S_y = diag(output_scale)`, `S_u = diag(input_scale)` every response is
`S_y^-1 G S_u`. Residuals, covers and weights live in these coordinates. In physical units an output-side residual is `S_y E S_y^-1`, an
input-side one `S_u E S_u^-1`, an additive one `S_y E S_u^-1`, an inverse additive one `S_u E S_y^-1`: the weights act on scaled signals.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, save_artifact
from ..core.lti import StateSpace
from .forms import Form
from .quantified import Quantified
from .weights.certificate import Method
from .weights.cover import Cover, Structure
from .weights.entrywise import EntrywiseWeight
from .weights.full import FullWeight
from .weights.weight import Weight

Array = npt.NDArray[Any]

_KINDS: dict[Structure, type[Weight]] = {Structure.ENTRYWISE: EntrywiseWeight, Structure.FULL: FullWeight}
_OWN_FACTS = {Structure.ENTRYWISE: ("unstructured_excess",), Structure.FULL: ("saved_db",)}
_FRAMES = ("left_frame", "right_frame")


@dataclass(frozen=True, eq=False, kw_only=True)
class UncertainModel(Quantified):
    """A nominal model and a bound on how the units of the population differ from it.

    Parameters
    ----------
    nominal_system : StateSpace
        In physical units; all others are those of `Quantified`.
    """

    nominal_system: StateSpace

    @property
    def sample_period_s(self) -> float:
        """Sampling period, s."""
        return self.nominal_system.dt

    def scaled_nominal(self) -> StateSpace:
        """Return the nominal between scaled inputs and outputs, on which the weights act."""
        return scale_system(self.nominal_system, self.output_scale, self.input_scale)

    def save(self, folder: Path) -> None:
        """Write ``arrays.npz`` and ``uncertain_model.json``."""
        arrays: dict[str, Array] = {
            "freqs_hz": self.freqs_hz,
            "output_scale": self.output_scale,
            "input_scale": self.input_scale,
            "misfit": self.misfit,
            **{f"bound_{form.value}": bound for form, bound in self.bounds.items()},
            **_pack_system("nominal", self.nominal_system),
            **_pack_weight("weight", self.weight, self.cover),
        }
        content: dict[str, Any] = {
            "form": self.form,
            "unit_ids": self.unit_ids,
            "nominal": self.nominal,
            "nominal_id": self.nominal_id,
            "sample_period_s": self.sample_period_s,
            "nominals": {form.value: unit for form, unit in self.nominals.items()},
            "peak_db": {form.value: peak for form, peak in self.peak_db.items()},
            "misfit_max": self.misfit_max,
            "misfit_unknown": int(np.isnan(self.misfit).sum()),
            "weight": _facts(self.weight),
            "remainder": None,
        }
        if self.remainder is not None and self.remainder_cover is not None:
            arrays |= _pack_weight("remainder", self.remainder, self.remainder_cover)
            content["remainder"] = _facts(self.remainder)
        save_artifact(Path(folder), "uncertain_model", content, arrays)

    @classmethod
    def load(cls, folder: Path) -> UncertainModel:
        """Read what `save` wrote."""
        content, arrays = load_artifact(Path(folder), "uncertain_model")
        dt = content["sample_period_s"]
        weight, cover = _unpack_weight("weight", content["weight"], arrays, dt)
        remainder, remainder_cover = (
            _unpack_weight("remainder", content["remainder"], arrays, dt) if content["remainder"] is not None else (None, None)
        )
        return cls(
            form=Form(content["form"]),
            unit_ids=tuple(content["unit_ids"]),
            nominal=content["nominal"],
            nominal_id=content["nominal_id"],
            nominal_system=_unpack_system("nominal", arrays, dt),
            freqs_hz=arrays["freqs_hz"],
            output_scale=arrays["output_scale"],
            input_scale=arrays["input_scale"],
            bounds={Form(name): arrays[f"bound_{name}"] for name in content["nominals"]},
            nominals={Form(name): unit for name, unit in content["nominals"].items()},
            cover=cover,
            weight=weight,
            misfit=arrays["misfit"],
            remainder=remainder,
            remainder_cover=remainder_cover,
        )


def scale_system(system: StateSpace, output_scale: Array, input_scale: Array) -> StateSpace:
    """Return `S_y^-1 G S_u`; states that are the outputs are scaled with them, so that all matrices have entries of common sizes."""
    rows = 1.0 / output_scale[:, None]
    if system.n_states == len(output_scale) and np.all(np.eye(system.n_states) == system.C):
        A, B = system.A * output_scale * rows, system.B * rows * input_scale
        return StateSpace(A, B, system.C, system.D * rows * input_scale, system.dt)
    return StateSpace(system.A, system.B * input_scale, system.C * rows, system.D * rows * input_scale, system.dt)


def _facts(weight: Weight) -> dict[str, Any]:
    own = {name: getattr(weight, name) for name in _OWN_FACTS.get(weight.structure, ())}
    return own | {
        "structure": weight.structure,
        "perturbation": weight.perturbation,
        "orders": [weight.left_orders, weight.right_orders],
        "cover_max": weight.cover_max,
        "overbound_db_max": weight.overbound_db_max,
        "overbound_entry_db": weight.overbound_entry_db,
        "within_tolerance": weight.within_tolerance,
        "method": weight.method,
        "remaining_margin": weight.remaining_margin,
    }


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _pack_system(name: str, system: StateSpace) -> dict[str, Array]:
    return {f"{name}_{x}": getattr(system, x) for x in "ABCD"}


def _unpack_system(name: str, arrays: dict[str, Array], dt: float) -> StateSpace:
    A, B, C, D = (arrays[f"{name}_{x}"] for x in "ABCD")
    return StateSpace(A, B, C, D, dt)


def _pack_weight(name: str, weight: Weight, cover: Cover) -> dict[str, Array]:
    systems = {"left": weight.left, "right": weight.right}
    if isinstance(weight, FullWeight):
        systems |= dict(zip(_FRAMES, weight.frames, strict=True))
    packed = {key: array for part, system in systems.items() for key, array in _pack_system(f"{name}_{part}", system).items()}
    return packed | {f"{name}_cover_left": cover.left, f"{name}_cover_right": cover.right}


def _unpack_weight(name: str, facts: dict[str, Any], arrays: dict[str, Array], dt: float) -> tuple[Weight, Cover]:
    structure = Structure(facts["structure"])
    own: dict[str, Any] = {field: _number(facts[field]) for field in _OWN_FACTS.get(structure, ())}
    if structure is Structure.FULL:
        own |= {part: _unpack_system(f"{name}_{part}", arrays, dt) for part in _FRAMES}
    weight = _KINDS.get(structure, Weight)(
        **own,
        left=_unpack_system(f"{name}_left", arrays, dt),
        right=_unpack_system(f"{name}_right", arrays, dt),
        left_orders=tuple(facts["orders"][0]),
        right_orders=tuple(facts["orders"][1]),
        structure=structure,
        cover_max=facts["cover_max"],
        overbound_db_max=facts["overbound_db_max"],
        within_tolerance=facts["within_tolerance"],
        overbound_entry_db=_number(facts.get("overbound_entry_db")),
        method=Method(facts.get("method", Method.GRID)),
        remaining_margin=_number(facts.get("remaining_margin")),
    )
    return weight, Cover(arrays[f"{name}_cover_left"], arrays[f"{name}_cover_right"])
