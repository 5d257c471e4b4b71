"""Errors of kros.

Every message says what was asked, what was found (unit, episode, channel, value) and what to do next. The command line
maps `DataError`, `ConfigError`, `DimensionError` and `MissingDependencyError` to exit code 2 while nothing has been
computed, and everything else to 1.
"""


class KrosError(Exception):
    """Base class of all errors that kros raises on purpose.

    Examples
    --------
    >>> from kros.core import DataError, KrosError
    >>> issubclass(DataError, KrosError)
    True
    """


class DataError(KrosError, ValueError):
    """Recordings that cannot be used as they are.

    Examples
    --------
    >>> import kros
    >>> kros.read("no/such/folder")
    Traceback (most recent call last):
    kros.core.errors.DataError: Reading no/such/folder: there is no such folder; check data.source.
    """


class DimensionError(KrosError, ValueError):
    """Arrays or systems whose sizes do not fit together.

    Examples
    --------
    >>> from kros.core import gain
    >>> gain([[1.0, 2.0]], 0.01) @ gain([[1.0]], 0.01)
    Traceback (most recent call last):
    kros.core.errors.DimensionError: Series connection: 2 inputs at 0.01 s against 1 outputs at 0.01 s; match them.
    """


class ConfigError(KrosError, ValueError):
    """A study, mapping or option that is not valid.

    Examples
    --------
    >>> import kros
    >>> issubclass(kros.core.ConfigError, ValueError)
    True
    """


class IdentificationError(KrosError):
    """A model could not be identified, or is not usable.

    Examples
    --------
    >>> import kros
    >>> issubclass(kros.core.IdentificationError, kros.core.KrosError)
    True
    """


class SynthesisError(KrosError):
    """An observer could not be synthesised, or did not survive verification.

    Examples
    --------
    >>> import kros
    >>> issubclass(kros.core.SynthesisError, kros.core.KrosError)
    True
    """


class MissingDependencyError(KrosError, ImportError):
    """An optional package is needed for what was asked.

    Examples
    --------
    >>> import kros
    >>> issubclass(kros.core.MissingDependencyError, ImportError)
    True
    """
