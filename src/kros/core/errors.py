"""Errors of kros.

Every message says what was asked, what was found (unit, episode, channel, value) and what to do next.
The command line maps `DataError`, `ConfigError` and `DimensionError` to exit code 2 while nothing has been computed, and everything else to 1.
"""


class KrosError(Exception):
    """Base class of all errors that kros raises on purpose."""


class DataError(KrosError, ValueError):
    """Recordings that cannot be used as they are."""


class DimensionError(KrosError, ValueError):
    """Arrays or systems whose sizes do not fit together."""


class ConfigError(KrosError, ValueError):
    """A study, mapping or option that is not valid."""


class IdentificationError(KrosError):
    """A model could not be identified, or is not usable."""


class SynthesisError(KrosError):
    """An observer could not be synthesised, or did not survive verification."""


class ExportError(KrosError):
    """An export target could not be written or verified."""


class MissingDependencyError(KrosError, ImportError):
    """An optional package is needed for what was asked."""
