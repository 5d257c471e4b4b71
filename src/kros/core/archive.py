"""Arrays in an .npz: bytes that depend on the content alone, read without trusting any size that the file states."""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .errors import DataError

_ENDING = ".npy"
_DAMAGED: tuple[type[Exception], ...] = (zipfile.BadZipFile, struct.error, tokenize.TokenError, SyntaxError, OSError)
_DAMAGED += (EOFError, ValueError, LookupError, TypeError, ArithmeticError, RuntimeError)  # of bytes that were changed


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return an .npz of arrays, without pickle and not compressed."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}{_ENDING}", date_time=(1980, 1, 1, 0, 0, 0)), content.getvalue())
    return buffer.getvalue()


def unpack_arrays(packed: bytes, path: Path) -> dict[str, np.ndarray]:
    """Return what `pack_arrays` packed."""
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            return {info.filename.removesuffix(_ENDING): _array(info, archive) for info in archive.infolist()}
    except _DAMAGED as error:
        problem = f"not a valid archive of arrays ({error or type(error).__name__})"
        raise DataError(f"Reading {path}: {problem}; write it again with the step that made it.") from error


def _array(info: zipfile.ZipInfo, archive: zipfile.ZipFile) -> np.ndarray:
    """Return one array, whose header states as many bytes as there are."""
    name = info.filename
    if not name.endswith(_ENDING) or info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise ValueError(f"{name!r} is compressed, which kros never does, or not an array")
    content = archive.read(info)  # checks the CRC
    file = io.BytesIO(content)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"{name!r} has a header of another version")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    start, count = file.tell(), math.prod(shape)
    if dtype.hasobject or min(shape, default=0) < 0 or count * dtype.itemsize != len(content) - start:
        raise ValueError(f"{name!r} holds {len(content) - start} bytes, {dtype} of shape {shape} would not")
    values = np.frombuffer(content, dtype, count, start).reshape(shape, order="F" if fortran else "C")
    return np.array(values, order="K")
