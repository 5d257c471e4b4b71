"""The study: configuration, stages, run folder, executors.

Examples
--------
>>> from pathlib import Path
>>> from kros.study import validate_config
>>> study = validate_config({"data": {"source": "recordings", "reader": "parquet"}}, Path())
>>> study.identify.alpha, study.evaluate.confidence
('auto', 0.95)
"""

from .config import Stage, StudyConfig, load_config, validate_config
from .pipeline import RunResult, run

__all__ = ["RunResult", "Stage", "StudyConfig", "load_config", "run", "validate_config"]
