"""How a folder of CSV files maps to a population: the keys of a mapping file and of ``[data.csv]`` in a study."""

from __future__ import annotations

import codecs
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, field_validator, model_validator

from ...core.files import read_toml
from ...core.settings import Settings
from ..population import Channel, Role, Scaling, columns_in_order
from ..prepare import parse_steps
from ..steps import Scale, Step
from .tables import Dialect

Column = str | Annotated[int, Field(ge=1)]  # a name in the header, or a number counted from 1
GROUPS = ("unit", "condition", "episode", "group")


class ChannelMapping(Settings):
    """``[[channel]]``: a channel and the column it is read from."""

    name: str = Field(description="of the channel, in everything that follows")
    role: Role = Field(description="what it is to the observer; a truth serves evaluation alone")
    column: Column | None = Field(None, description="name in the header or number from 1; default: the channel's name")
    measured: bool = Field(False, description="whether a state is available at run time")
    unit: str = Field("", description="unit of measure after scaling")
    scale: float = Field(1.0, description="factor from the column to the channel")
    truth_of: str = Field("", alias="of", description="for the role `truth`: the state that it is the truth of")

    @property
    def place(self) -> Column:
        """Where it is read from."""
        return self.name if self.column is None else self.column

    @property
    def declared(self) -> Channel:
        """The channel of the population."""
        return Channel(self.name, self.role, self.unit, self.measured, self.truth_of)


class CsvMapping(Settings):
    r"""How a folder of CSV files maps to a population; a file that does not match `files` is left alone."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    files: str = Field(
        description="regular expression searched in the path relative to the folder (with `/`); the named groups "
        "`unit`, `condition`, `episode` and `group` say what a file is, a missing one gets a default"
    )
    channel: tuple[ChannelMapping, ...] = Field(description="the channels, in any order")
    time: Column | None = Field(None, description="column of time")
    time_scale: float = Field(1.0, gt=0, description="factor from the column of time to seconds")
    sample_period_s: float | None = Field(None, gt=0, description="in place of a column of time")
    exclude: str | None = Field(None, description="regular expression; paths in which it occurs are left out")
    delimiter: str = Field(",", description="between columns; a tab is written `\\t`")
    header: bool = Field(True, description="false where the first line holds numbers; columns are then given by number")
    skip_rows: int = Field(0, ge=0, description="lines before the header, or before the first line of numbers")
    unit_rows: int = Field(0, ge=0, description="lines between the header and the numbers, such as units of measure")
    decimal: str = Field(".", description="decimal point, for example `,` in files of some countries")
    encoding: str = Field("utf-8", description="of the text, for example cp1252 or utf-16")
    timestamp: Literal["ymd", "dmy", "mdy"] | None = Field(
        None,
        description="where time is a timestamp such as `2024-05-31 12:00:00.010`: the order of its date; a time of day "
        "alone takes any of them",
    )
    pieces: int = Field(
        1, ge=1, le=100_000, description="a file is cut into episodes of equal length, `<episode>.1` ..."
    )
    prepare: tuple[dict[str, Any] | Step, ...] = Field((), description="preparation steps of this mapping")
    metadata: dict[str, Any] = Field({}, description="facts about the batch, for example `{gear_ratio = 100}`")

    @field_validator("files", "exclude")
    @classmethod
    def _expression(cls, value: str | None) -> str | None:
        try:
            unknown = sorted(set(re.compile(value or "").groupindex) - set(GROUPS))
        except (re.error, RecursionError, OverflowError) as error:
            raise ValueError(f"{value!r} is not a regular expression ({error})") from error
        if unknown:
            raise ValueError(f"names the group {unknown[0]!r}; known groups are {', '.join(GROUPS)}")
        return value

    @field_validator("encoding")
    @classmethod
    def _known(cls, value: str) -> str:
        try:
            codecs.lookup(value)
        except LookupError as error:
            raise ValueError(f"encoding {value!r} is unknown; known are utf-8, latin-1, cp1252, utf-16 ...") from error
        return value

    @model_validator(mode="after")
    def _consistent(self) -> CsvMapping:
        """Check what a type cannot say."""
        if (self.time is None) == (self.sample_period_s is None):
            actual = f"time = {self.time!r}, sample_period_s = {self.sample_period_s!r}"
            raise ValueError(f"give one of time and sample_period_s, found {actual}")
        if not (_is_mark(self.delimiter) and _is_mark(self.decimal)) or self.delimiter == self.decimal:
            wanted = "two different characters of ASCII that stand in no number otherwise"
            actual = f"delimiter = {self.delimiter!r}, decimal = {self.decimal!r}"
            raise ValueError(f"delimiter and decimal should be {wanted}, found {actual}")
        if not self.channel:
            raise ValueError("there is no [[channel]]; declare each channel with name, column and role")
        columns = (self.time, *(c.place for c in self.channel))
        named = next((column for column in columns if isinstance(column, str)), None)
        if named is not None and not self.header:
            raise ValueError(f"header = false leaves columns without names, found {named!r}; give its number from 1")
        return self

    @property
    def ordered(self) -> tuple[ChannelMapping, ...]:
        """Channels, states before inputs, truths behind them."""
        return columns_in_order(self.channel)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The population's channels."""
        return tuple(c.declared for c in self.ordered)

    @property
    def steps(self) -> tuple[Step, ...]:
        """Scaling as declared per channel, then the mapping's own steps."""
        scales = (Scale((c.name,), c.scale) for c in self.ordered if c.scale != 1)
        return (*scales, *parse_steps(self.prepare, "CSV mapping: prepare"))

    @property
    def scaling(self) -> dict[str, Scaling]:
        """Columns of the channels, before any step."""
        return {c.name: Scaling(c.place) for c in self.channel}

    @property
    def dialect(self) -> Dialect:
        """How its files are written."""
        return Dialect(self.delimiter, self.header, self.skip_rows, self.decimal, self.encoding, self.unit_rows)

    def without(self, names: Collection[str]) -> CsvMapping:
        """Return the mapping without some channels."""
        steps = [step.without(names) for step in parse_steps(self.prepare, "CSV mapping: prepare")]
        channels = tuple(c for c in self.channel if c.name not in names)
        return self.model_copy(update={"channel": channels, "prepare": tuple(step for step in steps if step)})


def _is_mark(text: str) -> bool:
    return len(text) == 1 and text.isascii() and not text.isalnum() and text not in '"+-\r\n\0'


def load_mapping(mapping: CsvMapping | Mapping[str, Any] | Path | str) -> CsvMapping:
    """Return a mapping from a TOML file or a table with the same keys."""
    if isinstance(mapping, CsvMapping):
        return mapping
    if isinstance(mapping, Mapping):
        return CsvMapping.of(mapping, "CSV mapping")
    return CsvMapping.of(read_toml(Path(mapping), "CSV mapping"), f"CSV mapping {mapping}")
