"""The study: one TOML file, validated; unknown keys are errors; the resolved form is stored with the results."""

import tomllib
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, TypeAdapter, field_validator

from ..core import ConfigError, Names, Record, Settings, read_toml, shortened
from ..data.readers.csv_folder import CsvMapping
from ..data.steps import STEPS
from ..design.settings import ObserverSettings, SynthesisSettings
from ..identify.settings import CalibrationSettings, IdentifySettings, LiftingSettings
from ..observer import EstimatorSettings, Sensor
from ..uncertainty.settings import UncertaintySettings


class Stage(StrEnum):
    """Stages in the order in which data flow.

    Examples
    --------
    >>> from kros.study import Stage
    >>> [stage.value for stage in Stage]
    ['read', 'calibrate', 'identify', 'quantify', 'synthesize', 'evaluate', 'left_out', 'report']
    """

    READ = "read"
    CALIBRATE = "calibrate"
    IDENTIFY = "identify"
    QUANTIFY = "quantify"
    SYNTHESIZE = "synthesize"
    EVALUATE = "evaluate"
    LEFT_OUT = "left_out"
    REPORT = "report"


class DataConfig(Settings):
    """Where the recordings are and how they are prepared."""

    source: Path = Field(description="folder of the recordings, relative to the study file")
    reader: str = Field("motor-drive-raw", description="motor-drive-raw, csv (tables in files of any kind) or parquet")
    exclude: Names = Field((), description="units that take no part in anything")
    identify_on: str | None = Field(
        None, description="condition that models and observers are made from; by default noload, or else the first"
    )
    on_nan: Literal["error", "drop_episode"] = Field(
        "error", description="what an episode with a missing value is: an error, or left out"
    )
    prepare: tuple[Record, ...] = Field((), description="preparation steps, in order")
    csv: CsvMapping | None = Field(None, description="the mapping, for the reader csv")

    @field_validator("source")
    @classmethod
    def _nameable(cls, value: Path) -> Path:
        if "\0" in str(value):
            raise ValueError("data.source should be a path, without NUL")
        return value


class SplitConfig(Settings):
    """Which episodes are held out."""

    test: Names | None = Field(
        None, description="episodes held out; by default the last tenth of every unit and condition, at least one"
    )


class EvaluateConfig(Settings):
    """Evaluation on units that took no part."""

    folds: int = Field(
        0, ge=0, description="folds of units left out in turn, the whole study being made on all others; 0 for none"
    )
    reserve: int = Field(
        0, ge=0, description="units that take part in nothing; their errors bound those of the next unit"
    )
    confidence: float = Field(0.95, gt=0, lt=1, description="of that bound")


class LoadConfig(Settings):
    """Load torque ``moment sin(position) + inertia position''``, over the torque constant, of a mounted mass."""

    moment: float | None = Field(
        None, description="of the mounted mass, in units of current; without it nothing is done about load"
    )
    inertia: float = Field(0.0, ge=0, description="of the mounted mass, in the same units")
    units: Names = Field(
        (), description="on which the load is known; by default the first two recorded in the condition load"
    )


class StudyConfig(Settings):
    """A whole study.

    Examples
    --------
    >>> from pathlib import Path
    >>> from kros.study import validate_config
    >>> study = validate_config({"data": {"source": "recordings", "reader": "parquet"}}, Path())
    >>> study.name, study.synthesis.methods
    ('study', ('mixed', 'worst_case_h2', 'residual_h2', 'estimator'))
    """

    name: str = Field("study", description="of the study")
    data: DataConfig
    split: SplitConfig = SplitConfig()
    lifting: LiftingSettings = LiftingSettings()
    calibrate: CalibrationSettings = CalibrationSettings()
    identify: IdentifySettings = IdentifySettings()
    uncertainty: UncertaintySettings = UncertaintySettings()
    synthesis: SynthesisSettings = SynthesisSettings()
    estimator: EstimatorSettings = EstimatorSettings()
    sensor: dict[str, Sensor] = Field(default_factory=dict)
    observer: ObserverSettings = ObserverSettings()
    evaluate: EvaluateConfig = EvaluateConfig()
    load: LoadConfig = LoadConfig()

    def dump(self) -> Record:
        """Return the resolved study in JSON's types."""
        return self.model_dump(mode="json")


def load_config(path: Path | str, overrides: Sequence[str] = ()) -> StudyConfig:
    """Read a study file and apply ``KEY=VALUE`` overrides such as ``identify.alpha=90``.

    Raises
    ------
    ConfigError
        When the file is missing, not TOML, or holds unknown keys or values out of range.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from kros.study import load_config
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder, "study.toml")
    ...     _ = file.write_text("[data]{0}source = 'recordings'{0}reader = 'parquet'".format(chr(10)))
    ...     print(load_config(file, ["evaluate.confidence=0.9"]).evaluate.confidence)
    0.9
    """
    path = Path(path)
    raw = read_toml(path, "Study")
    raw.setdefault("name", path.stem)
    return validate_config(raw, path.parent, str(path), overrides)


def validate_config(raw: Record, base: Path, origin: str = "study", overrides: Sequence[str] = ()) -> StudyConfig:
    """Validate a study given as tables; a relative source is relative to `base`, overrides are as in `load_config`.

    Examples
    --------
    >>> from pathlib import Path
    >>> from kros.study import validate_config
    >>> tables = {"data": {"source": "recordings", "reader": "parquet"}}
    >>> study = validate_config(tables, Path(), overrides=["identify.alpha=90"])
    >>> study.identify.alpha
    90.0
    """
    for override in overrides:
        _apply(raw, override)
    config = StudyConfig.of(raw, f"Study {origin}")
    source = (base / config.data.source).resolve()
    return config.model_copy(update={"data": config.data.model_copy(update={"source": source})})


def study_schema() -> Record:
    """Return the JSON schema of a study file, with all preparation steps."""
    schema = StudyConfig.model_json_schema()
    steps = {name: TypeAdapter(kind).json_schema() for name, kind in STEPS.items()}
    for name, step in steps.items():
        step["properties"]["step"] = {"const": name}
    schema["$defs"]["DataConfig"]["properties"]["prepare"]["items"] = {"oneOf": list(steps.values())}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def stored_config(raw: Any, path: Path) -> StudyConfig:
    """Return the resolved study of a run folder."""
    try:
        return StudyConfig.of(raw, f"Run {path.parent}: {path.name}")
    except ConfigError as error:
        raise ConfigError(f"{error} It is damaged, or of another version of kros; run the study again.") from error


def _apply(raw: Record, override: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {override!r}: should look like KEY=VALUE, for example identify.alpha=90.")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
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
