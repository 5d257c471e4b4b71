"""Settings: what a function takes beside its data, with defaults and limits in one place for Python and TOML alike."""

from enum import Enum
from typing import Any, Self, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from . import limits
from .arrays import T
from .errors import ConfigError
from .files import did_you_mean, shortened

E = TypeVar("E", bound=Enum)
_OF_FAMILIES = (TypeError, LookupError, AttributeError, ArithmeticError, MemoryError, RecursionError)  # their arguments


class Settings(BaseModel):
    """Base of all settings: unknown names are errors, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, ser_json_inf_nan="constants")

    @classmethod
    def of(cls, raw: Any, asked: str) -> Self:
        """Validate, with every problem in one message that begins with what was asked."""
        try:
            return cls.model_validate(raw)
        except ValidationError as error:
            texts = (f"{'.'.join(map(str, e['loc']))}: {cls._explain(e)}" for e in error.errors())
            problems = "; ".join(text.removeprefix(": ") for text in texts)
            raise ConfigError(f"{asked}: {shortened(problems, 2000)}.") from error
        except _OF_FAMILIES as error:
            reason = f"{type(error).__name__}: {shortened(str(error))}"
            raise ConfigError(f"{asked}: {reason}; check the values of [[lifting.families]].") from error

    @field_validator("*", mode="before")
    @classmethod
    def _sized(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse truth values where numbers are asked for, and numbers that nothing can be computed with."""
        kind = cls.model_fields[info.field_name or ""].annotation
        if isinstance(value, bool) and bool not in (kind, *get_args(kind)):
            raise ValueError("input should not be true or false")
        if isinstance(value, int | float) and abs(value) > limits.MAX_VALUE:
            raise ValueError(f"input should be at most {limits.MAX_VALUE:g} in size")
        return value

    @classmethod
    def _explain(cls, error: Any) -> str:
        if error["type"] == "extra_forbidden":
            known = cls._names_in(error["loc"][:-1])
            return f"unknown key{did_you_mean(error['loc'][-1], known)} known are {', '.join(known)}"
        text, value = error["msg"].removeprefix("Value error, "), error.get("input")
        text = text[:1].lower() + text[1:]
        return text if isinstance(value, dict) else f"{text}, found {shortened(repr(value))}"

    @classmethod
    def _names_in(cls, place: tuple[Any, ...]) -> list[str]:
        """Return the names that are known in a table inside these settings."""
        settings: Any = cls
        for name in place:  # a mapping's keys are free
            held = get_args(settings)  # of a dict the keys and values, of a tuple the items
            settings = held[get_origin(settings) is dict] if held else settings.model_fields[name].annotation
        return [field.alias or name for name, field in settings.model_fields.items()]


def require_kind(value: object, kind: type[T], asked: str, instead: str) -> T:
    """Return a value of the class that a function takes, and refuse any other."""
    if not isinstance(value, kind):
        raise ConfigError(f"{asked}: needs {kind.__name__}, found {type(value).__name__}; {instead}.")
    return value


def member(kind: type[E], value: E | str, what: str) -> E:
    """Return the member of an enumeration by its name, or raise a `ConfigError` that lists the names."""
    try:
        return kind(value)
    except ValueError as error:
        names = ", ".join(str(m.value) for m in kind)
        raise ConfigError(f"{what} {value!r} is unknown; choose one of {names}.") from error
