"""The study: configuration, stages, run folder, executors."""

from .config import Stage, StudyConfig, load_config, validate_config
from .pipeline import run_study

__all__ = ["Stage", "StudyConfig", "load_config", "run_study", "validate_config"]
