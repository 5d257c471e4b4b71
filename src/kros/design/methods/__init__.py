"""The methods of observer design, from the plainest to the one that is preferred where others are as accurate."""

import logging
from collections.abc import Iterable

from ...observer import EstimatorSettings
from ..task import Method, split_name
from .estimator import Estimator
from .gains import KalmanTuned, OpenLoop, ResidualH2
from .robust import Mixed, Published, WorstCaseH2

log = logging.getLogger(__name__)
METHODS: tuple[Method, ...] = (
    OpenLoop(),
    KalmanTuned(),
    Published(),
    Mixed(),
    ResidualH2(),
    WorstCaseH2(),
    Estimator(),
)


def methods_of(names: Iterable[str], estimator: EstimatorSettings) -> list[Method]:
    """Return methods by their names, in the order of all; names of what is no method are left out."""
    wanted = set(names)
    return [Estimator(estimator) if isinstance(m, Estimator) else m for m in METHODS if m.name in wanted]


def suitable(methods: Iterable[Method], kind: str) -> list[Method]:
    """Return the methods that are for a kind of model; reasons of others are logged."""
    suited = []
    for method in methods:
        if refusal := method.refusal(kind):
            log.info("%s/%s is not designed: %s.", kind, method.name, refusal)
        else:
            suited.append(method)
    return suited


def preferred(observers: Iterable[str]) -> str | None:
    """Return the observer ``<kind of model>/<method>`` whose method is preferred; None where there is none."""
    names = [method.name for method in METHODS]
    known = [name for name in observers if split_name(name)[1] in names]
    return max(known, key=lambda name: names.index(split_name(name)[1]), default=None)
