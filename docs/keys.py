"""Tables of the keys of a study, a mapping and preparation steps, written from their models when the documentation is built (`keys.md`)."""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path

from kros.core.settings import Settings
from kros.data.readers.csv_folder import ChannelMapping, CsvMapping, UnitMapping
from kros.data.steps import STEPS
from kros.study.config import StudyConfig

LIMITS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
WORDS = {str: "text", bool: "true or false", int: "whole number", float: "number", Path: "path", types.NoneType: ""}


def written(kind: object) -> str:
    """Return what may stand behind a key."""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return " or ".join(f"`{shown(value)}`" for value in inside)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(filter(None, map(written, inside)))
    if origin is tuple:
        return (
            "list of tables"
            if dataclasses.is_dataclass(inside[0]) or "table" in written(inside[0])
            else f"list: {written(inside[0])}"
        )
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return "table"
    if isinstance(kind, type) and kind in WORDS:
        return WORDS[kind]
    members = [member.value for member in kind] if isinstance(kind, type) and hasattr(kind, "__members__") else []
    return " or ".join(f"`{shown(value)}`" for value in members) or "table"


def shown(value: object) -> str:
    """Return a value as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return (
        f"[{', '.join(map(shown, value))}]"
        if isinstance(value, tuple)
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )


def default(value: object) -> str:
    """Return a default for a cell of a table."""
    return "" if value is None or isinstance(value, Mapping) or value == () else f"`{shown(value)}`"


def table(rows: list[tuple[str, str, str, str]]) -> str:
    """Return a table of keys in Markdown."""
    cells = [("key", "value", "default", "meaning"), ("---",) * 4, *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in cells) + "\n"


def sections(model: type[Settings]) -> Iterator[tuple[str, type[Settings]]]:
    """Yield the tables of a study by name, those with free names too."""
    for name, field in model.model_fields.items():
        kind, inside = field.annotation, typing.get_args(field.annotation)
        if isinstance(kind, type) and issubclass(kind, Settings):
            yield name, kind
        elif len(inside) == 2 and isinstance(inside[1], type) and issubclass(inside[1], Settings):
            yield f"{name}.<state>", inside[1]


def settings_rows(model: type[Settings]) -> list[tuple[str, str, str, str]]:
    """Return the rows of one table of a study; tables inside it have rows of their own."""
    inner = {name.split(".")[0] for name, _ in sections(model)}
    rows = []
    for name, field in model.model_fields.items():
        if name in inner:
            continue
        bounds = [
            f"{word} {getattr(limit, key):g}"
            for limit in field.metadata
            for key, word in LIMITS.items()
            if hasattr(limit, key)
        ]
        value = ", ".join([written(field.annotation), *bounds])
        said = "required" if field.is_required() else default(None if field.default_factory else field.default)
        rows.append((f"`{field.alias or name}`", value, said, field.description or ""))
    return rows


def dataclass_rows(kind: type) -> list[tuple[str, str, str]]:
    """Return key, value and default of a table that is read into a dataclass."""
    hints, rows = typing.get_type_hints(kind), []
    for field in dataclasses.fields(kind):
        said = "required" if field.default is dataclasses.MISSING else default(field.default)
        rows.append((f"`{field.name}`", written(hints[field.name]), said))
    return rows


def summary(kind: type) -> str:
    """Return the docstring before its sections, with code in single backticks."""
    return re.split(r"\n\n(?:Parameters|Examples)\n", inspect.getdoc(kind) or "")[0].replace("``", "`")


def study_keys() -> str:
    """Return a section for every table of a study."""
    parts = [f"### Keys outside of tables\n\n{table(settings_rows(StudyConfig))}"]
    parts += [
        f"### `[{name}]`\n\n{summary(kind)}\n\n{table(settings_rows(kind))}" for name, kind in sections(StudyConfig)
    ]
    return "\n".join(parts)


def mapping_keys() -> str:
    """Return a section for every table of a mapping."""
    kinds = {"### At the top": CsvMapping, "### `[[channel]]`": ChannelMapping, "### `[[unit]]`": UnitMapping}
    return "\n".join(f"{title}\n\n{summary(kind)}\n\n{table(settings_rows(kind))}" for title, kind in kinds.items())


def step_keys() -> str:
    """Return a section for every preparation step."""
    parts = []
    for name, kind in STEPS.items():
        lines = "\n".join(
            "| " + " | ".join(row) + " |" for row in [("key", "value", "default"), ("---",) * 3, *dataclass_rows(kind)]
        )
        parts.append(f"### `{name}`\n\n{summary(kind)}\n\n{lines}\n")
    return "\n".join(parts)


TABLES = {"study": study_keys, "mapping": mapping_keys, "steps": step_keys}


def fill(text: str) -> str:
    """Return a page with its comments `<!-- keys: study -->` replaced by tables."""
    return re.sub(r"^<!-- keys: (\w+) -->$", lambda found: TABLES[found[1]](), text, flags=re.MULTILINE)


def setup(app: typing.Any) -> dict[str, bool]:
    """Have Sphinx fill pages as it reads them."""

    def read(_app: object, _name: str, source: list[str]) -> None:
        source[0] = fill(source[0])

    app.connect("source-read", read)
    return {"parallel_read_safe": True}
