"""Observer design: from uncertain models to an observer, by any method, with what is certified about it.

Examples
--------
>>> from kros.design import PredictorSettings, SynthesisSettings
>>> SynthesisSettings(methods=["memory"]).methods, PredictorSettings(effort="quick").effort
(('memory',), 'quick')

`kros.synthesize` shows a whole design.
"""

from .settings import ObserverSettings, PredictorSettings, SynthesisSettings
from .synthesize import Design, Designs, synthesize, synthesize_all

__all__ = ["Design", "Designs", "ObserverSettings", "PredictorSettings", "SynthesisSettings", "synthesize", "synthesize_all"]
