"""Preparation as declared steps: small frozen objects, applied to each episode in the order given.

Each step tells what it does to the channels and the sampling period (`channels_after`, `period_after`), so that a population
can be described before anything is read, and does it to one recording at a time (`apply`). No step changes its argument.
In TOML a step is a table with its name under `step`: ``[[data.prepare]] step = "trim" start = 1000``.

Examples
--------
>>> import numpy as np
>>> import kros
>>> population = kros.from_arrays({"a": [np.arange(6.0)[:, None]]}, states=["x"], measured=["x"], sample_period_s=0.01)
>>> prepared = kros.data.prepare(population, [kros.data.steps.Trim(start=2)])
>>> len(prepared.read(prepared.keys()[0]))
4
"""

from ...core.removed import refusing
from .filtered import Differentiate, Resample
from .parsing import parse_steps
from .pointwise import Offset, Scale, Shift, Trim
from .step import Step

__all__ = ["Differentiate", "Offset", "Resample", "Scale", "Shift", "Step", "Trim", "parse_steps"]
__getattr__ = refusing(__name__)
