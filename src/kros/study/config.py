"""The study: one TOML file, validated; unknown keys are errors; the resolved form is stored with the results."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from ..core.errors import ConfigError
from ..core.files import parse_toml, read_toml, shortened
from ..lifting import check_family

FORMS = Literal[
    "additive",
    "input_multiplicative",
    "output_multiplicative",
    "inverse_additive",
    "inverse_input_multiplicative",
    "inverse_output_multiplicative",
]
METHODS = Literal["mixed", "paper", "worst_case_h2", "worst_case_hinf", "residual_h2", "memory"]
BASELINES = Literal["open_loop", "kalman_white", "kalman_tuned", "luenberger", "ekf", "filtered_difference", "learned"]


class Stage(str, Enum):
    """Stages in the order in which data flow."""

    READ = "read"
    CALIBRATE = "calibrate"
    IDENTIFY = "identify"
    QUANTIFY = "quantify"
    SYNTHESIZE = "synthesize"
    EVALUATE = "evaluate"
    LEFT_OUT = "left_out"
    REPORT = "report"


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DataConfig(_Section):
    """Where the recordings are and how they are prepared; units that `exclude` names take no part in anything."""

    source: Path
    reader: str = "motor-drive-raw"
    exclude: tuple[str, ...] = ()
    identify_on: str | None = None
    on_nan: Literal["error", "drop_episode"] = "error"
    prepare: tuple[dict[str, Any], ...] = ()
    csv: dict[str, Any] | None = None

    @field_validator("source")
    @classmethod
    def _nameable(cls, value: Path) -> Path:
        if "\0" in str(value):
            raise ValueError("data.source should be a path, without NUL")
        return value


class SplitConfig(_Section):
    """Which episodes are held out."""

    test: tuple[str, ...] | None = None


class LiftingConfig(_Section):
    """Lifted functions of the Koopman model; where none are declared, those that suit the plant that the reader names.

    `families` are tables, each with a ``kind``, whose formulas stand behind `functions`; `input_functions` are further inputs of the model.
    """

    functions: tuple[str, ...] | None = None
    families: tuple[dict[str, Any], ...] = ()
    input_functions: tuple[str, ...] = ()
    parameters: tuple[str, ...] | None = None

    @field_validator("families")
    @classmethod
    def _known(cls, value: tuple[dict[str, Any], ...]) -> tuple[dict[str, Any], ...]:
        for table in value:
            check_family(table)
        return value


class CalibrateConfig(_Section):
    """Phase calibration; ``None`` takes what suits the plant that the reader names."""

    angle: str | None = None
    ratio: float | None = Field(None, gt=0)
    reference: str | None = None
    measured: str | None = None
    settle_s: float = Field(0.1, ge=0)


class IdentifyConfig(_Section):
    """Regularisation; ``auto`` is `alpha_factor` times the smallest coefficient that stabilises every model.

    At the smallest coefficient itself one unit has a pole on the stability limit, and no uncertainty model of the population is finite; the factor
    is doubled until the peak residual around the best nominal unit is at most `largest_residual`, where that can be reached.
    `refine` adds models that are refined on their free-run error, the population first, then each unit, held near the population's model by
    a prior that is never so weak that the peak residual exceeds `largest_residual`. Spectral radii stay below ``1 - margin``.
    """

    alpha: float | Literal["auto"] = "auto"
    alpha_factor: float = Field(4.0, ge=1)
    refine: bool = True
    largest_residual: float = Field(0.5, gt=0)
    margin: float = Field(0.0, ge=0, lt=1)

    @field_validator("alpha")
    @classmethod
    def _not_negative(cls, value: float | str) -> float | str:
        if isinstance(value, float) and value < 0:
            raise ValueError("alpha should be 'auto' or a number of at least 0")
        return value


class UncertaintyConfig(_Section):
    """Uncertainty model and outlier scores."""

    form: FORMS = "inverse_input_multiplicative"
    nominal: str | None = None
    structure: Literal["auto", "diagonal", "scalar", "full", "entrywise"] = "auto"
    n_freqs: int = Field(1000, ge=50)
    max_order: int = Field(4, ge=1, le=8)
    tolerance_db: float = Field(1.0, gt=0)
    drop_outliers: bool = False
    outlier_form: FORMS = "additive"
    false_alarm_rate: float = Field(3e-3, gt=0, lt=1)


class SynthesisConfig(_Section):
    """Observer synthesis."""

    methods: tuple[METHODS, ...] = ("mixed", "worst_case_h2", "residual_h2", "memory")
    injection: Literal["state", "input"] = "state"
    input_weight: float | Literal["tuned", "identity"] = Field("tuned", description="corner of the low-pass spectrum of the inputs in Hz")
    noise: dict[str, float] = Field(default_factory=dict, description="standard deviation of the measurement noise per measured channel")
    penalty: float = Field(1e-3, gt=0)
    max_states: int | None = Field(
        None, ge=0, description="most states of the filter of worst_case_h2; reduced and polished where it has more"
    )
    tune: bool = Field(False, description="whether residual_h2 is tuned on training episodes, which takes some seconds a kind of model")
    time_limit_s: float = Field(60.0, gt=0)


class MemoryConfig(_Section):
    """The observer with a memory.

    As many tuning `steps` as these, on so many `episodes` of every unit, keep a study short; 25 and 2 take half a minute, and are what an observer that
    goes into machines is worth. `importance` weights the logarithmic errors of states that are not measured, by name; one where none is given.
    """

    states: int = Field(12, ge=1, description="states besides the recorded ones")
    steps: int = Field(4, ge=0)
    episodes: int = Field(1, ge=1)
    importance: dict[str, float] = Field(default_factory=dict)

    @field_validator("importance")
    @classmethod
    def _positive(cls, value: dict[str, float]) -> dict[str, float]:
        for name, weight in value.items():
            if not 0 < weight < float("inf"):
                raise ValueError(f"memory.importance.{name} should be a positive number")
        return value


class ObserverConfig(_Section):
    """Which observers are compared, and which one is handed over.

    The extended Kalman filter runs on the first lifted model (on a linear one it is the tuned Kalman filter); ``filtered_difference`` and
    ``learned`` need no model.
    """

    baselines: tuple[BASELINES, ...] = get_args(BASELINES)
    deployed: str | None = None


class EvaluateConfig(_Section):
    """Evaluation on units that took no part, on disturbed measurements, and on machines that might be.

    With `folds` the pooled units are parted into so many folds, and for each the study is made once more on all other units; 0 leaves that out.
    With `robustness` observers of the kind of model that is handed over run on disturbed measurements of a few units, with "all" every observer on all
    units in all conditions. `monte_carlo` is the number of random members of the certified set that observers are computed for; 0 leaves that out.
    """

    folds: int = Field(0, ge=0)
    robustness: bool | Literal["all"] = True
    monte_carlo: int = Field(100, ge=0)

    @field_validator("folds")
    @classmethod
    def _several(cls, value: int) -> int:
        if value == 1:
            raise ValueError("folds should be 0 or at least 2: one fold would leave no unit to learn from")
        return value


class LoadConfig(_Section):
    """Load torque: what is mounted on `units` in a condition; without `moment` nothing is done about it.

    The load is ``moment sin(angle - angle_rad) + inertia angle''``, both divided by the torque constant: in units of current. Without `units`
    the first two that were recorded in the condition are taken; all others are judged on. `limit` is the current's.
    """

    moment: float | None = None
    inertia: float = Field(0.0, ge=0)
    angle_rad: float = 0.0
    condition: str = "load"
    units: tuple[str, ...] = ()
    angle: str = "position"
    current: str = "current"
    limit: float | None = Field(None, gt=0)
    memories: int = Field(8, ge=0)
    level_s: float = Field(10.0, gt=0)


class RequireConfig(_Section):
    """Requirements whose violation ends the run with exit code 3."""

    robust: bool = False
    no_outliers: bool = False


class StudyConfig(_Section):
    """A whole study."""

    name: str = "study"
    data: DataConfig
    split: SplitConfig = SplitConfig()
    lifting: LiftingConfig = LiftingConfig()
    calibrate: CalibrateConfig = CalibrateConfig()
    identify: IdentifyConfig = IdentifyConfig()
    uncertainty: UncertaintyConfig = UncertaintyConfig()
    synthesis: SynthesisConfig = SynthesisConfig()
    memory: MemoryConfig = MemoryConfig()
    observer: ObserverConfig = ObserverConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    load: LoadConfig = LoadConfig()
    require: RequireConfig = RequireConfig()

    def dump(self) -> dict[str, Any]:
        """Return the resolved study in JSON's types."""
        return self.model_dump(mode="json")


def load_config(path: Path | str, overrides: Sequence[str] = ()) -> StudyConfig:
    """Read a study file and apply ``KEY=VALUE`` overrides such as ``identify.alpha=90``.

    Raises
    ------
    ConfigError
        When the file is missing, not TOML, or holds unknown keys or values out of range.
    """
    path = Path(path)
    raw = read_toml(path, "Study")
    for override in overrides:
        _apply(raw, override)
    raw.setdefault("name", path.stem)
    return validate_config(raw, path.parent, str(path))


def validate_config(raw: dict[str, Any], base: Path, origin: str = "study") -> StudyConfig:
    """Validate a study given as nested tables; a relative source is relative to `base`."""
    config = _validated(raw, f"Study {origin}")
    source = (base / config.data.source).resolve()
    return config.model_copy(update={"data": config.data.model_copy(update={"source": source})})


def stored_config(raw: Any, path: Path) -> StudyConfig:
    """Return the resolved study of a run folder.

    Raises
    ------
    ConfigError
        Damaged, or of another version of kros.
    """
    try:
        return _validated(raw, f"Run {path.parent}: {path.name}")
    except ConfigError as error:
        raise ConfigError(f"{error} It is damaged, or of another version of kros; run the study again.") from error


def _validated(raw: Any, origin: str) -> StudyConfig:
    """Validate, with every problem in one message."""
    try:
        return StudyConfig.model_validate(raw)
    except ValidationError as error:
        problems = "; ".join(f"{'.'.join(str(p) for p in e['loc'])}: {_explain(e)}" for e in error.errors())
        raise ConfigError(f"{origin}: {shortened(problems, 2000)}.") from error
    except (TypeError, LookupError, AttributeError, ArithmeticError, MemoryError, RecursionError) as error:  # of a family's arguments
        raise ConfigError(
            f"{origin}: {type(error).__name__}: {shortened(str(error))}; check the values of [[lifting.families]]."
        ) from error


def _explain(error: Any) -> str:
    if error["type"] == "extra_forbidden":
        return "unknown key; check the spelling against the documentation"
    found = error.get("input")
    return f"{error['msg'].lower()}, found {shortened(repr(found))}" if not isinstance(found, dict) else error["msg"].lower()


def _apply(raw: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {override!r}: should look like KEY=VALUE, for example identify.alpha=90.")
    try:
        value = parse_toml(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"--set {shortened(override)!r}: {shortened(str(error))}; correct the value.") from error
    *tables, last = key.strip().split(".")
    table = raw
    for name in tables:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ConfigError(f"--set {override!r}: {name} is a value, not a table; check the key.")
    table[last] = value
