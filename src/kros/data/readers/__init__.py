"""One reader per file; each returns a lazy `Population`. `read` takes one by name."""

from .arrays import from_arrays
from .csv_folder import read_csv_folder
from .csv_mapping import CsvMapping
from .frame import from_frame
from .motor_drive_raw import read_motor_drive_raw
from .opening import READERS, detect_reader, read
from .parquet import read_parquet
from .pykoop_array import from_pykoop, to_pykoop

__all__ = [
    "READERS",
    "CsvMapping",
    "detect_reader",
    "from_arrays",
    "from_frame",
    "from_pykoop",
    "read",
    "read_csv_folder",
    "read_motor_drive_raw",
    "read_parquet",
    "to_pykoop",
]
