"""How much a file may declare before mvcore takes it: sizes are checked before memory is.

A few kilobytes can declare gigabytes (images, archives) or nest without end (YAML, JSON, XML). The limits are far above what
calibrations and images hold, and far below what a machine of 16 GB has.
"""

from __future__ import annotations

import json
import lzma
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, MvcoreError

MOST_TEXT = 64 << 20
"""Bytes of a calibration file that is read as text."""
MOST_NODES = 1_000_000
"""Values of a YAML, XML or JSON file."""
MOST_DEPTH = 64
"""Levels of nesting of a YAML, XML or JSON file; calibrations have four."""

MOST_INTEGER = 18
"""Digits, with a sign, of a whole number that stays one."""
MOST_SIDE = (1 << 15) - 2
"""Pixels along a side of an image that OpenCV remaps; and of a camera in files of rigs, whose sensors are smaller."""
MOST_ARRAYS = 1 << 30
"""Bytes of the arrays of an archive that are read, by default."""
NPY_MAGIC = b"\x93NUMPY"
NPY_HEADER = 4096
"""Most bytes of an array's header; NumPy's own are 118 long, or a little more."""
NPY_FIELDS = {
    "descr": re.compile(r"'descr': *'([<>|=]?[biufc?][0-9]{0,2})'"),
    "order": re.compile(r"'fortran_order': *(True|False)"),
    "shape": re.compile(r"'shape': *\(([0-9, ]*)\)"),
}


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """A UTF-8 text file (a byte order mark is passed over) of at most ``most`` bytes.

    Raises
    ------
    OSError
        The file cannot be read.
    FormatError
        Another kind of file than a regular one, a larger file, or one that is no UTF-8 text.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise FormatError(f"{path}:{line}: not a UTF-8 text file") from None


def read_bytes(path: Path, most: int) -> bytes:
    """A regular file's bytes, at most ``most`` of them; raises as `read_text`."""
    if path.exists() and not path.is_file():
        raise FormatError(f"{path}: expected a regular file")
    with path.open("rb") as file:
        if os.fstat(file.fileno()).st_size > most:
            raise FormatError(f"{path}: expected a file of at most {most >> 20} MiB")
        return file.read()


def read_json(path: Path, most: int = MOST_TEXT) -> Any:
    """A JSON file's content. Whole numbers of more than 18 digits are floats.

    Raises
    ------
    OSError
        The file cannot be read.
    FormatError
        Not JSON, nested too deep, or larger than ``most`` bytes; the message starts with path and line.
    """
    text = read_text(path, most)
    try:
        return json.loads(text, parse_int=lambda digits: int(digits) if len(digits) <= MOST_INTEGER else float(digits))
    except json.JSONDecodeError as error:
        raise FormatError(f"{path}:{error.lineno}: {error.msg}") from None
    except RecursionError:
        raise FormatError(f"{path}:1: nested too deep") from None


def inside(folder: Path, name: Any, source: Path) -> Path:
    """The file ``name`` in a folder, which neither ``..`` nor a link leads out of it.

    Raises
    ------
    FormatError
        Not a relative path within the folder; the message names ``source``, the file that says the name.
    """
    where = (folder / name).resolve() if isinstance(name, str) and name and "\0" not in name else None
    if where is None or not where.is_relative_to(folder.resolve()):
        raise FormatError(f"{source}: expected the path of a file in {folder}, got {name!r:.200}")
    return where


def read_npz(path: Path, names: Callable[[str], bool] = lambda _: True, most: int = MOST_ARRAYS) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz`` archive of plain numbers, without unpickling.

    Sizes are checked before memory is taken: what an entry's header declares must be what the archive holds of it.

    Parameters
    ----------
    path : the archive.
    names : which arrays are read, by name.
    most : bytes that all of them together may have.

    Raises
    ------
    OSError
        The file cannot be read.
    FormatError
        Not an archive of number arrays, damaged, or larger than ``most``; the message names path and array.
    """
    out: dict[str, NDArray[Any]] = {}
    name = ""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [i for i in archive.infolist() if i.filename.endswith(".npy") and names(i.filename[:-4])]
            total = sum(i.file_size for i in entries)
            if total > most:
                raise FormatError(f"{path}: its arrays declare {total} bytes, more than the allowed {most}")
            for entry in entries:
                name = entry.filename
                with archive.open(entry) as file:
                    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                        raise ValueError("compressed otherwise than NumPy does")
                    out[name[:-4]] = _array(file, entry.file_size)
    except (MvcoreError, FileNotFoundError, PermissionError, IsADirectoryError):
        raise
    except (ValueError, RuntimeError, OSError, EOFError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error) as error:
        where = f"{name}: " if name else ""
        raise FormatError(f"{path}: {where}not an archive of number arrays: {error or type(error).__name__}") from None
    return out


def _array(file: IO[bytes], size: int) -> NDArray[Any]:
    """One ``.npy`` entry of ``size`` bytes."""
    start = file.read(8)
    if start[:6] != NPY_MAGIC or len(start) < 8 or start[6] not in (1, 2, 3):
        raise ValueError("not an array file")
    width, kind = (2, "<H") if start[6] == 1 else (4, "<I")
    (length,) = struct.unpack(kind, file.read(width))
    if length > NPY_HEADER:
        raise ValueError(f"a header of {length} bytes")
    header = file.read(length).decode("latin-1")
    fields = {key: pattern.search(header) for key, pattern in NPY_FIELDS.items()}
    if not all(fields.values()):
        raise ValueError(f"expected an array of plain numbers, got {header.strip():.80}")
    descr, order, dims = (str(match[1]) for match in fields.values() if match)
    shape = tuple(int(n) for n in dims.replace(" ", "").split(",") if n)
    dtype = np.dtype(descr)
    if len(shape) > 32 or math.prod(shape) * dtype.itemsize != size - 8 - width - length:
        raise ValueError(f"its header declares {' x '.join(map(str, shape))} of {dtype}, it holds {size - 8 - width - length} bytes")
    data = file.read()
    return np.frombuffer(bytearray(data), dtype).reshape(shape, order="F" if order == "True" else "C")
