"""The study: configuration, stages, run folder, executors."""

from .config import Stage, StudyConfig, load_config, validate_config
from .pipeline import RunResult, run, run_study

__all__ = ["RunResult", "Stage", "StudyConfig", "load_config", "run", "run_study", "validate_config"]
