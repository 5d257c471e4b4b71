"""Ground floor: systems, norms, artifacts and errors. Imports nothing else of kros.

Examples
--------
>>> from kros.core import StateSpace, hinf_norm
>>> lag = StateSpace([[0.5]], [[0.5]], [[1.0]], [[0.0]], 0.01)  # 0.5 / (z - 0.5), every 0.01 s
>>> round(hinf_norm(lag), 9)
1.0
"""

from .arrays import AnyArray, Array, ArrayLike, Bits, ByName, Columns, Flags, Names, Parameters, Record, Whole, frozen
from .artifacts import Storable, digest_of, load_artifact, loader, plain, read_json, save_artifact, united, write_json
from .errors import (
    ConfigError,
    DataError,
    DimensionError,
    IdentificationError,
    KrosError,
    MissingDependencyError,
    SynthesisError,
)
from .files import did_you_mean, is_file, read_toml, require_regular, shortened, stamp_of, whole_folder, write_bytes
from .lti import StateSpace, block_diagonal, gain
from .norms import h2_norm, hinf_norm
from .rounding import AGREED, EPS, ITERATED, ROUNDING, SINGULAR, TINY
from .settings import Settings, member, require_kind
from .work import Mapped, Progress, Work, grouped

__all__ = [
    "ConfigError",
    "DataError",
    "DimensionError",
    "IdentificationError",
    "KrosError",
    "MissingDependencyError",
    "StateSpace",
    "SynthesisError",
    "block_diagonal",
    "gain",
    "h2_norm",
    "hinf_norm",
]
