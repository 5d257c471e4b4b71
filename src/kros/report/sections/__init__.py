"""Sections of the report, from ``metrics.json`` alone: first what decides, then the evidence, which is folded."""

from collections.abc import Callable

from ..content import Section
from ..facts import Facts
from .certificates import certificates
from .deployment import deployment
from .errors import errors, left_out, other_conditions
from .evidence import calibration, models, recordings, run, spread, uncertainty
from .units import units

Makers = tuple[Callable[[Facts], Section | None], ...]
FIRST: Makers = (deployment, errors, units)
EVIDENCE: Makers = (recordings, calibration, models, spread, uncertainty, certificates, left_out, other_conditions, run)
