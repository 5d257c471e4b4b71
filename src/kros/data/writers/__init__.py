"""Writers of populations: kros's Parquet, and the paper's raw layout; folders appear whole or not at all."""

from .folders import whole_folder
from .parquet import GroupRecord, write_group, write_index, write_parquet
from .raw import write_raw

__all__ = ["GroupRecord", "whole_folder", "write_group", "write_index", "write_parquet", "write_raw"]
