"""The kinds of models in their order: with or without lifted functions, refined or by EDMD alone."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.errors import ConfigError
from ..lifting import Lifting


@dataclass(frozen=True)
class ModelKind:
    """One kind of model: with lifted functions or without, refined on free-run error or not."""

    name: str
    lifted: bool
    refined: bool

    def lifting(self, lifting: Lifting) -> Lifting:
        """Return the lifting of this kind."""
        return lifting if self.lifted else Lifting(lifting.states)


KINDS = (
    ModelKind("koopman", lifted=True, refined=True),
    ModelKind("linear", lifted=False, refined=True),
    ModelKind("koopman_edmd", lifted=True, refined=False),
    ModelKind("linear_edmd", lifted=False, refined=False),
)


def kind_of(name: str) -> ModelKind:
    """Return a kind by its name."""
    kinds = {kind.name: kind for kind in KINDS}
    if name not in kinds:
        raise ConfigError(f"Kind of model {name!r}: is unknown; known are {', '.join(kinds)}.")
    return kinds[name]


def kinds_for(lifting: Lifting, *, refined: bool) -> tuple[ModelKind, ...]:
    """Return the kinds of models, refined or by EDMD, of a lifting: without functions the linear one alone."""
    has_functions = bool(lifting.functions + lifting.input_functions)
    return tuple(kind for kind in KINDS if kind.refined == refined and (has_functions or not kind.lifted))
