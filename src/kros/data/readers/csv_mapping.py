"""How a folder of CSV files maps to a population: the keys of a mapping file and of ``[data.csv]`` in a study."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from ...core.errors import ConfigError
from ...core.files import read_toml
from ..population import Channel, Role, TrueChannel, columns_in_order
from ..scaling import Scaling
from ..steps import Scale, Step, parse_steps
from ..tables import build
from .csvfile import Dialect

Column = str | int  # a name in the header, or a number counted from 1
GROUPS = ("unit", "condition", "episode", "group")


@dataclass(frozen=True)
class ChannelMapping:
    """``[[channel]]``: a channel and the column it is read from.

    Parameters
    ----------
    name : str
        Of the channel, in everything that follows.
    role : Role
        What it is to the observer; a truth serves evaluation alone.
    column : str or int, optional
        Name in the header or number from 1; default: the channel's name.
    measured : bool
        Whether a state is available at run time.
    unit : str
        Unit of measure after scaling.
    scale : float
        Factor from the column to the channel.
    of : str
        For the role ``truth``: the state that it is the truth of.
    """

    name: str
    role: Role
    column: Column | None = None
    measured: bool = False
    unit: str = ""
    scale: float = 1.0
    of: str = ""

    @property
    def declared(self) -> Channel:
        """The channel of the population."""
        if self.role is not Role.TRUTH and not self.of:
            return Channel(self.name, self.role, self.unit, self.measured)
        return TrueChannel(self.name, self.role, self.unit, self.measured, self.of)


@dataclass(frozen=True)
class UnitMapping:
    """``[[unit]]``: one of several units in the same file.

    Parameters
    ----------
    suffix : str
        Appended to the unit's id from the path.
    columns : mapping
        Column by name of channel; other channels keep the column of their ``[[channel]]``.
    """

    suffix: str = ""
    columns: Mapping[str, Column] = field(default_factory=dict)


@dataclass(frozen=True)
class CsvMapping:
    r"""How a folder of CSV files maps to a population.

    Parameters
    ----------
    files : str
        Regular expression searched in the path relative to the folder (with ``/``); named groups `unit`, `condition`, `episode` and `group`
        say what a file is. A missing group gets a default. Files that do not match are left alone.
    channel : tuple of ChannelMapping
        The channels, in any order.
    time : str or int, optional
        Column of time.
    unit : tuple of UnitMapping
        Where one file holds several units.
    time_scale : float
        Factor from the column of time to seconds.
    sample_period_s : float, optional
        In place of a column of time.
    exclude : str, optional
        Regular expression; paths in which it is found are left out.
    delimiter : str
        Between columns; ``"\\t"`` for tabs.
    header : bool
        False where the first line holds numbers already; columns are then given by number.
    skip_rows : int
        Lines before the header, or before the first line of numbers.
    unit_rows : int
        Lines between the header and the numbers, such as units of measure.
    decimal : str
        Decimal point, for example ``","`` in files of some countries.
    encoding : str
        Of the text, for example ``cp1252`` or ``utf-16``; a mark at the start of the file is left out.
    timestamp : {"ymd", "dmy", "mdy"}, optional
        Where time is a timestamp such as ``2024-05-31 12:00:00.010``: the order of its date. A time of day alone takes any of them.
    pieces : int
        Every file is cut into so many episodes of equal length, named ``<episode>.1`` and so on.
    prepare : tuple of mapping
        Preparation steps of this mapping.
    metadata : mapping
        Facts about the batch, for example ``{plant = "harmonic-drive", gear_ratio = 100}``.
    """

    files: str
    channel: tuple[ChannelMapping, ...]
    time: Column | None = None
    unit: tuple[UnitMapping, ...] = ()
    time_scale: float = 1.0
    sample_period_s: float | None = None
    exclude: str | None = None
    delimiter: str = ","
    header: bool = True
    skip_rows: int = 0
    unit_rows: int = 0
    decimal: str = "."
    encoding: str = "utf-8"
    timestamp: Literal["ymd", "dmy", "mdy"] | None = None
    pieces: int = 1
    prepare: tuple[Mapping[str, Any] | Step, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check what a type cannot say."""
        if (self.time is None) == (self.sample_period_s is None):
            raise ConfigError(
                f"CSV mapping: give one of time and sample_period_s, found time = {self.time!r}, sample_period_s = "
                f"{self.sample_period_s!r}."
            )
        self._check_numbers()
        if not (_is_mark(self.delimiter) and _is_mark(self.decimal)) or self.delimiter == self.decimal:
            found = f"delimiter = {self.delimiter!r}, decimal = {self.decimal!r}"
            wanted = "two different characters of ASCII that stand in no number otherwise"
            raise ConfigError(f"CSV mapping: delimiter and decimal should be {wanted}, found {found}; correct them.")
        for name, least in (("skip_rows", 0), ("unit_rows", 0), ("pieces", 1)):
            if getattr(self, name) < least:
                raise ConfigError(
                    f"CSV mapping: {name} should be at least {least}, found {getattr(self, name)}; correct it."
                )
        _check_encoding(self.encoding)
        if not self.channel:
            raise ConfigError("CSV mapping: there is no [[channel]]; declare each channel with name, column and role.")
        self._check_pattern("files")
        self._check_pattern("exclude")
        self._check_columns()

    def _check_numbers(self) -> None:
        """Refuse what no time and no scale can be."""
        periods = {} if self.sample_period_s is None else {"sample_period_s": self.sample_period_s}
        for name, value in {**periods, "time_scale": self.time_scale}.items():
            if not 0 < value < math.inf:
                raise ConfigError(f"CSV mapping: {name} should be a number above zero, found {value}; correct it.")
        for channel in self.channel:
            if not math.isfinite(channel.scale) or channel.scale == 0:
                raise ConfigError(
                    f"CSV mapping: the scale of channel {channel.name!r} should be finite and not zero, found {channel.scale}."
                )

    def _check_pattern(self, name: str) -> None:
        try:
            found = re.compile(getattr(self, name) or "").groupindex
        except (re.error, RecursionError, OverflowError) as error:
            raise ConfigError(
                f"CSV mapping: {name} = {getattr(self, name)!r} is not a regular expression ({error}); correct it."
            ) from error
        unknown = sorted(set(found) - set(GROUPS))
        if unknown:
            raise ConfigError(
                f"CSV mapping: {name} names the group {unknown[0]!r}; known groups are {', '.join(GROUPS)}."
            )

    def _check_columns(self) -> None:
        names = [c.name for c in self.channel]
        for unit in self.units:
            unknown = sorted(set(unit.columns) - set(names))
            if unknown:
                raise ConfigError(
                    f"CSV mapping: [[unit]] {unit.suffix!r} gives a column for {unknown[0]!r}; the channels are {names}."
                )
        used = [self.time, *(self.column(c, u) for u in self.units for c in self.channel)]
        for column in used:
            if isinstance(column, int) and column < 1:
                raise ConfigError(f"CSV mapping: columns are numbered from 1, found {column}; correct it.")
            if isinstance(column, str) and not self.header:
                raise ConfigError(
                    f"CSV mapping: header = false leaves columns without names, found {column!r}; give its number, counted from 1."
                )

    @property
    def units(self) -> tuple[UnitMapping, ...]:
        """The units of one file; one without a suffix where none is declared."""
        return self.unit or (UnitMapping(),)

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
        return (
            *(Scale((c.name,), c.scale) for c in self.ordered if c.scale != 1),
            *parse_steps(self.prepare, "CSV mapping: prepare"),
        )

    @property
    def scaling(self) -> dict[str, Scaling]:
        """Columns of the channels, before any step."""
        columns = {c.name: {self.column(c, unit) for unit in self.units} for c in self.channel}
        return {name: Scaling(next(iter(own)) if len(own) == 1 else None) for name, own in columns.items()}

    def without(self, names: Collection[str]) -> CsvMapping:
        """Return the mapping without some channels."""
        units = tuple(replace(u, columns={k: v for k, v in u.columns.items() if k not in names}) for u in self.unit)
        steps = tuple(
            step for s in parse_steps(self.prepare, "CSV mapping: prepare") if (step := s.without(names)) is not None
        )
        return replace(self, channel=tuple(c for c in self.channel if c.name not in names), unit=units, prepare=steps)

    def column(self, channel: ChannelMapping, unit: UnitMapping) -> Column:
        """Return where a channel of a unit is read from."""
        return unit.columns.get(channel.name, channel.name if channel.column is None else channel.column)

    @property
    def dialect(self) -> Dialect:
        """How its files are written."""
        return Dialect(self.delimiter, self.header, self.skip_rows, self.decimal, self.encoding, self.unit_rows)


def _check_encoding(name: str) -> None:
    try:
        codecs.lookup(name)
    except LookupError as error:
        raise ConfigError(
            f"CSV mapping: encoding {name!r} is unknown; known are utf-8, latin-1, cp1252, utf-16 and others of Python."
        ) from error


def _is_mark(text: str) -> bool:
    return len(text) == 1 and text.isascii() and not text.isalnum() and text not in '"+-\r\n\0'


def load_mapping(mapping: CsvMapping | Mapping[str, Any] | Path | str) -> CsvMapping:
    """Return a mapping from a TOML file or a table with the same keys."""
    if isinstance(mapping, CsvMapping):
        return mapping
    if isinstance(mapping, Mapping):
        return build(CsvMapping, mapping, "CSV mapping")
    return build(CsvMapping, read_toml(Path(mapping), "CSV mapping"), f"CSV mapping {mapping}")
