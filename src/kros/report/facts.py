"""``metrics.json`` with what verdict and sections ask of it; any part but ``study`` may be absent."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from ..core import ByName, Names, frozen
from ..design.task import split_name
from .error_tables import ErrorTable, error_tables
from .names import observer_label, readable_unit


@frozen
class Facts:
    """The metrics of one run."""

    metrics: ByName

    def get(self, name: str, otherwise: Any = None) -> Any:
        """Return a part of the metrics, or what is given otherwise."""
        return self.metrics.get(name, otherwise)

    @property
    def study(self) -> ByName:
        """What the study is about."""
        return self.metrics["study"]

    @property
    def measured(self) -> Names:
        """Channels that are measured at run time."""
        return tuple(self.study.get("measured", ()))

    @property
    def observers(self) -> Mapping[str, ByName]:
        """What is known of every observer."""
        return self.get("observers", {})

    @property
    def deployed(self) -> str:
        """Name of the deployed observer; empty where there is none."""
        return self.study.get("deployed") or ""

    @property
    def label(self) -> str:
        """What the deployed observer is called."""
        return observer_label(self.deployed)

    @property
    def entry(self) -> ByName:
        """What is known of the deployed observer."""
        return self.observers.get(self.deployed, {})

    @property
    def model(self) -> str:
        """Model of the deployed observer."""
        return split_name(self.deployed)[0]

    @cached_property
    def tables(self) -> list[ErrorTable]:
        """Errors of all observers, a table a condition, that of the models first."""
        return error_tables(self.metrics)

    @property
    def table(self) -> ErrorTable | None:
        """Errors in the condition that the deployed observer was designed for; None where it has not been evaluated."""
        return self.tables[0] if self.tables and self.deployed in self.tables[0].cells else None

    @property
    def hidden(self) -> list[str]:
        """Channels that the deployed observer estimates and that are not measured."""
        return self.table.hidden(self.measured, self.deployed) if self.table is not None else []

    def unit(self, channel: str) -> str:
        """Return the unit of measure of a channel; nothing where there is none."""
        return readable_unit(self.study.get("channels", {}).get(channel, ""))
