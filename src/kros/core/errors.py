"""Errors of kros.

Every message says what was asked, what was found (unit, episode, channel, value) and what to do next. The command line
maps `DataError`, `ConfigError` and `DimensionError` to exit code 2 while nothing has been computed, and everything else
to 1.
"""


class KrosError(Exception):
    """Base class of all errors that kros raises on purpose.

    Examples
    --------
    >>> import kros
    >>> try:
    ...     kros.read("no/such/folder")
    ... except kros.core.KrosError as error:  # whatever kros refuses
    ...     print(type(error).__name__)
    DataError
    """


class DataError(KrosError, ValueError):
    """Recordings that cannot be used as they are.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> try:
    ...     kros.from_arrays({"a": [np.ones((5, 2))]}, states=["x"], inputs=["u"], sample_period_s=0.01)
    ... except kros.core.DataError as error:
    ...     print(error)
    from_arrays: measured should name the states that a running observer will be given, found [] for the states ['x'];
    name one of them at least.
    """


class DimensionError(KrosError, ValueError):
    """Arrays or systems whose sizes do not fit together.

    Examples
    --------
    >>> from kros.core import DimensionError, StateSpace
    >>> try:
    ...     StateSpace([[0.5]], [[1.0], [1.0]], [[1.0]], [[0.0]], 0.01)
    ... except DimensionError as error:
    ...     print(error)
    State space: B should end in shape (1, 1), found {'A': (1, 1), 'B': (2, 1), 'C': (1, 1), 'D': (1, 1)}; transpose or
    pad the offending matrix.
    """


class ConfigError(KrosError, ValueError):
    """A study, mapping or option that is not valid.

    Examples
    --------
    >>> from kros.core import ConfigError
    >>> from kros.data.steps import parse_steps
    >>> try:
    ...     parse_steps([{"step": "trim", "stat": 1000}])
    ... except ConfigError as error:
    ...     print(error)
    data.prepare[0] (step 'trim'): unknown key 'stat'; did you mean 'start'? known keys are start, stop, tail.
    """


class IdentificationError(KrosError):
    """A model could not be identified, or is not usable.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import IdentificationError
    >>> from kros.identify import edmd
    >>> try:
    ...     edmd(np.zeros((3, 3)), n_lifted=1)
    ... except IdentificationError as error:
    ...     print(type(error).__name__)
    IdentificationError
    """


class SynthesisError(KrosError):
    """An observer could not be synthesised, or did not survive verification.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import SynthesisError
    >>> from kros.synthesis import kalman
    >>> try:
    ...     kalman(np.diag([0.5, 1.0]), [[1.0, 0.0]], np.eye(2), [[1.0]])  # the second state is not observed
    ... except SynthesisError as error:
    ...     print(type(error).__name__)
    SynthesisError
    """


class ExportError(KrosError):
    """An export target could not be written or verified.

    Examples
    --------
    >>> from kros.core import ExportError, KrosError
    >>> issubclass(ExportError, KrosError)
    True
    """


class MissingDependencyError(KrosError, ImportError):
    """An optional package is needed for what was asked.

    Examples
    --------
    >>> from kros.core import KrosError, MissingDependencyError
    >>> issubclass(MissingDependencyError, ImportError), issubclass(MissingDependencyError, KrosError)
    (True, True)
    """
