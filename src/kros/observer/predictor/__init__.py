"""Observers with a memory of what they saw.

`moments` collects what recordings say of hidden states and reduces it to a model of low order, `blocks` runs such models and says how their
estimates change, `tuning` improves them on recordings, `build` writes them into observers.
"""

from .build import observer_with_memory, remembering_observer
from .moments import Past
from .tuning import tune_memory

__all__ = ["Past", "observer_with_memory", "remembering_observer", "tune_memory"]
