"""Observers with a memory of what they saw.

`past` collects what recordings say of hidden states and reduces it to a model of low order, `blocks` runs such models and says how their
estimates change, `tuning` improves them on recordings, `made` writes them into observers.
"""

from .made import observer_with_memory, remembering_observer
from .past import Past
from .tuning import tune_memory

__all__ = ["Past", "observer_with_memory", "remembering_observer", "tune_memory"]
